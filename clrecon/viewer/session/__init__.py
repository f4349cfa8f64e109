"""What every face of a view holds: model, painter, workers and the table of commands."""
