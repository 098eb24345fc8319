"""Independent jobs on the cores of this computer or of a cluster, with the same results."""
