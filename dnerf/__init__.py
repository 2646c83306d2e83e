"""Dynamic-scene neural radiance fields: one deformation, one canonical field, one exact compositing renderer."""

__version__ = "0.1.0"
