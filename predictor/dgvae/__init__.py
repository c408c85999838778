"""The dG-VAE: the paper's model (Sec. IV) and this project's additions to it."""

from predictor.dgvae.config import PRESETS, DGVAEConfig
from predictor.dgvae.model import DGVAE

__all__ = ["PRESETS", "DGVAE", "DGVAEConfig"]
