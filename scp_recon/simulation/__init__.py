"""The spacecraft that flies a plan: its data, its guidance and control, and its simulation."""
