"""Speed of the engine compared with a peer, of vision, and of the cell's waits."""
