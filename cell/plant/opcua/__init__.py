"""OPC UA server: a cell's states, counters and commands after PackML (OPC 30050)."""
