"""Studies of feedback in flight: gains, replanning, and sites that need feedback."""
