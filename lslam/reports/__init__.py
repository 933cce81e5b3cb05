"""Evaluation and run records for people: text, tables, JSON, plots, HTML."""
