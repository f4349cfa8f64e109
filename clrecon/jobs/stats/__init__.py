"""Statistics of labels: volume and HU of each, as a report and a table."""
