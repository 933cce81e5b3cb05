"""Presentation of evaluations and run records: text, tables, JSON, plots, HTML."""
