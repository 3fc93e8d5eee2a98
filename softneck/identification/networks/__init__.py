"""The paper's NLARX network (section 6.2).

Training by Levenberg-Marquardt with exact derivatives.
May import `identification.models` and `.linear`, whose output-error model is the prior.
"""
