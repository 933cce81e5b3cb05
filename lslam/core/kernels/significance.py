"""Sigmas at which the tests of a scan's path decide."""

# A value stands out of its noise: one in twenty does by chance.
SIGNIFICANT_SIGMAS = 2.0
# A value is none of its noise: one in four hundred is by chance.
OUTLIER_SIGMAS = 3.0
