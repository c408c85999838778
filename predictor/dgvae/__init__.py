"""The dG-VAE: the paper's model (Sec. IV) and this project's additions to it."""

from predictor.dgvae.model import DGVAE
from predictor.dgvae.networks import PRESETS, DGVAEConfig

__all__ = ["PRESETS", "DGVAE", "DGVAEConfig"]
