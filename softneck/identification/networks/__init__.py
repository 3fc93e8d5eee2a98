"""Neural networks: the paper's NLARX network (section 6.2) and neural state spaces.

Training by Levenberg-Marquardt with exact derivatives.
May import `identification.models` and `.linear`, from which a state space starts.
"""
