"""Rays, samples, cameras, compositing: what every part exchanges."""
