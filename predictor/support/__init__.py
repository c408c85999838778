"""What every package uses and nothing of forecasting: errors, checks, files, command lines, provenance, the process."""
