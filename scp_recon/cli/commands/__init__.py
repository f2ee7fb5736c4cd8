"""The commands, one a module: options in, a call of `api`, results rendered."""
