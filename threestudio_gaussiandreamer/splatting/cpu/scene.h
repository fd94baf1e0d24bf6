// The C interface: plain structs of pointers into row-major float32 arrays, all owned by the caller.
#pragma once

#include <cstdint>

struct SplatScene {
  const float* means;            // (N, 3)
  const float* quats;            // (N, 4) w x y z, any length
  const float* scales;           // (N, 3) standard deviations
  const float* opacities;        // (N)
  const float* viewmats;         // (B, 4, 4) world to camera, OpenCV
  const float* colors;           // (N, 3) or, with colors_per_view, (B, N, 3)
  const float* background;       // (B, 3)
  const float* Ks;               // (B, 3, 3) pixels
  int64_t gaussians;             // N
  int32_t views, width, height;  // B and the rendered size
  int32_t colors_per_view;
};

struct SplatSettings {
  float near, far, eps2d, alpha_min, alpha_max, stop;
  int32_t antialias, downsample, threads;
};

// What a forward pass fills; pixels after the downsampling.
struct SplatPictures {
  float* image;         // (B, H, W, 3)
  float* alpha;         // (B, H, W)
  float* depth;         // (B, H, W)
  float* means2d;       // (B, N, 2)
  float* radii;         // (B, N)
  float* contribution;  // (B, N)
};

struct SplatUpstream {
  const float *image, *alpha, *depth;  // d loss / d pictures; null is zero
};

// What a backward pass fills; those that may be null aren't computed then.
struct SplatGradients {
  float *means, *quats, *scales, *opacities;  // as in SplatScene
  float* viewmats;                            // may be null
  float *colors, *background;
  float* means2d;  // (B, N, 2)
  float* absgrad;  // (B, N, 2), sums over the pixels of absolute values; may be null
};

// What a backward pass needs from its forward pass.
struct SplatState;

#pragma GCC visibility push(default)
extern "C" {
// 0, or the bytes of memory that would have been needed. With `state` not null it receives what a backward pass needs, to be
// given back by `splat_release`.
int64_t splat_forward(const SplatScene*, const SplatSettings*, const SplatPictures*, SplatState** state);
int64_t splat_backward(SplatState*, const SplatScene*, const SplatSettings*, const SplatUpstream*, const SplatGradients*);
void splat_release(SplatState*);  // null is ignored
// The best build for this processor: "v4", "v3" or "base".
const char* splat_best_isa();
}
#pragma GCC visibility pop
