"""Time integration: discrete equations, compiled code, one step, rollouts with sensitivities and adjoint, LQR.

The equations are in `discrete`; change them there and both the compiled and the interpreted kernel follow.
"""
