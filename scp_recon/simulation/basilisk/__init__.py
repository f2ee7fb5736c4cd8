"""The spacecraft as Basilisk's modules; needs the extra [sim]."""
