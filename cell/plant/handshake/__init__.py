"""Digital handshake: a PLC starts the cell by single bits, and reads the cell's state from bits."""
