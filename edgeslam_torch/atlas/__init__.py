"""Pieces of map that are found to be one: a place that looks known, the similarity between the pieces, the weld.

`places.py` asks which keyframes look alike, `links.py` proves that a keyframe shows another piece and how that piece
lies, `weld.py` moves the smaller piece and makes one map of both, and `atlas.py` decides: two keyframes must agree.
"""
