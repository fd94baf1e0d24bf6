// The inputs of a rasterisation: the one struct that Python fills for the CPU and the CUDA kernels (splatting/scene.py). Free of
// headers, as splat_math.h.
#pragma once

namespace splat {

// Row-major float32 arrays of N Gaussians and B views.
struct Scene {
  const float* means;            // (N, 3)
  const float* quats;            // (N, 4) w x y z, any length
  const float* scales;           // (N, 3) standard deviations
  const float* opacities;        // (N)
  const float* viewmats;         // (B, 4, 4) world to camera, OpenCV
  const float* colors;           // (N, 3) or, with colors_per_view, (B, N, 3)
  const float* background;       // (B, 3)
  const float* Ks;               // (B, 3, 3) pixels
  long long gaussians;           // N
  int views, width, height;      // B and the rendered size
  int colors_per_view;
};

}  // namespace splat
