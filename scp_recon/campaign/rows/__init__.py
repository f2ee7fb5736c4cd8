"""A case, what runs one, and the rows that come of cases."""
