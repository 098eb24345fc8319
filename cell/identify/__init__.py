"""Nodes over time → the parameters of this cable, with covariance."""
