"""Find, download and load pretrained models; embed text."""
