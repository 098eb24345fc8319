"""Plants around a cell: effects and cost of adapters and pages."""
