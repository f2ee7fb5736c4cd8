"""The scenario file: its schema, reading, inheritance and error messages."""
