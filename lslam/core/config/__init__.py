"""Configuration: one frozen model per section, TOML in, resolved TOML out, unknown keys answered with the nearest name."""

from lslam.core.config.config import Config, load_config, to_described_toml, to_toml

__all__ = ["Config", "load_config", "to_described_toml", "to_toml"]
