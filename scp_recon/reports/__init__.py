"""The report: one HTML file that shows plans, whole, without a network."""
