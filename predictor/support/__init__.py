"""Tools of all packages, unrelated to forecasting: errors, checks, files, command lines, provenance, processes."""
