"""Speed: of the engine beside its peer, of vision, of the waits of a cell."""
