"""The CUDA backend: kernels compiled by NVRTC on first use."""
