"""Time integration of the mechanical system, with sensitivities, adjoints, statics and LQR.

The equations are in `discrete`; change them there and both the compiled and the interpreted kernel follow.
"""
