"""Physics of a held cable: pure numbers in, pure numbers out; no I/O."""
