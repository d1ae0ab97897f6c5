"""Synthetic truth: a procedural stadium, cameras with known parameters, clips with the truth beside them.

Independent of mosaic, calib and pipelines on purpose: what judges them must not share their code.
"""
