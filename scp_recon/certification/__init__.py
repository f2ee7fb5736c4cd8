"""Plans whose promise is what nonlinear flights reach."""
