"""The bench job: times of the stages from scan to mesh, beside those of a peer."""
