"""What a case of a campaign costs beside its plan."""
