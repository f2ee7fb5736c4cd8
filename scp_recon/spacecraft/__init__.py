"""The spacecraft: its hardware, its attitude and its power."""
