"""Write the report: one HTML file that shows plans and works without a network."""
