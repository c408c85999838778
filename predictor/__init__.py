"""The trajectory predictor: dG-VAE, its streaming form, its training and its data. Knows nothing of gym."""
