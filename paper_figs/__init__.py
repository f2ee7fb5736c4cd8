"""Figures and tables from what experiments wrote; each module is one and runs by itself."""
