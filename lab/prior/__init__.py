"""Training of the embedded prior, `priors/tiny/`."""
