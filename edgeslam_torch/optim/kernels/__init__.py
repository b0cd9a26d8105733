"""The solver's arithmetic as plain loops: residuals with their derivatives, normal equations, Schur complement.

The modules of `losses` define the residuals; these loops are tested against their automatic derivatives.
"""
