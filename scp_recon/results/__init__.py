"""Stored plans: facts, figures, files, tables, comparison and folders of runs."""
