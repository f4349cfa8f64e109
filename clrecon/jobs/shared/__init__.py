"""What jobs have in common: checks, outputs, reports, masks."""
