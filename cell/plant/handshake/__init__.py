"""Digital handshake: a PLC starts the cell with single bits, and reads from bits what it does."""
