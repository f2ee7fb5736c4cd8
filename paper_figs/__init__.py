"""Figures drawn from solution files; each module is one picture and runs by itself."""
