// The C interface: plain structs of pointers into row-major float32 arrays, all owned by the caller.
#pragma once

#include <cstdint>

#include "splat_scene.h"

struct SplatSettings {
  float near, far, eps2d, alpha_min, alpha_max, stop;
  int32_t antialias, downsample, threads;
};

// Outputs of a forward pass; pixels after downsampling.
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

// Outputs of a backward pass; optional ones are null if they aren't needed.
struct SplatGradients {
  float *means, *quats, *scales, *opacities;  // as in splat::Scene
  float* viewmats;                            // may be null
  float *colors, *background;
  float* means2d;  // (B, N, 2)
  float* absgrad;  // (B, N, 2), sums over the pixels of absolute values; may be null
};

// State of a forward pass that its backward pass needs.
struct SplatState;

#pragma GCC visibility push(default)
extern "C" {
// 0, or the bytes of memory that would have been needed. If `state` is not null, it receives what a backward pass needs, to be
// freed by `splat_release`.
int64_t splat_forward(const splat::Scene*, const SplatSettings*, const SplatPictures*, SplatState** state);
int64_t splat_backward(SplatState*, const splat::Scene*, const SplatSettings*, const SplatUpstream*, const SplatGradients*);
void splat_release(SplatState*);  // null is ignored
// The best build for this processor: "v4", "v3" or "base".
const char* splat_best_isa();
}
#pragma GCC visibility pop
