"""Forces, frames, geometry and the flow of states and their derivatives."""
