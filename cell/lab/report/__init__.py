"""Findings as sentences, tables, figures and pages."""
