"""Read scenario files: schema, inheritance, computed entries and error messages."""
