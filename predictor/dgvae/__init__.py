"""The dG-VAE: the paper's model (Sec. IV) and what this project adds to it."""

from predictor.dgvae.model import DGVAE
from predictor.dgvae.networks import PRESETS, DGVAEConfig

__all__ = ["PRESETS", "DGVAE", "DGVAEConfig"]
