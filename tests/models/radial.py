"""Settings of measured radial velocities, for tests that measure them themselves."""

from src.models.layers.doppler import DopplerConfig

MEASURED = DopplerConfig(gaussians=True, cells=True, boxes=True, in_losses=True, along_heading=False)
