"""Fly a plan many times with errors, and summarise the flights."""
