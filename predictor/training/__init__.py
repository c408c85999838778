"""Training of a forecaster: settings, batches, objective and the run."""
