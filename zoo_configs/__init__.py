"""Shipped configurations, one YAML file per algorithm; read with :mod:`sb3_tbc.zoo.config`."""
