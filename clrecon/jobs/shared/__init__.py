"""The common parts of jobs: checks, outputs, reports, masks."""
