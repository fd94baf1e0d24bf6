// The C interface: plain structs of pointers into row-major float32 arrays, all owned by the caller.
#pragma once

#include <cstdint>

#include "splat_scene.h"

// Raised with every change of what follows, so that no library is called as another version of it.
constexpr int32_t SPLAT_INTERFACE = 2;

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
  float* colors;
  float* means2d;  // (B, N, 2)
  float* absgrad;  // (B, N, 2), sums over the pixels of absolute values; may be null
};

// State of a forward pass that its backward pass needs.
struct SplatState;

struct SplatKnownPictures {
  const float* render;      // (B, H, W, 3) in [0, 1]
  const uint8_t* const* pictures;  // B times (4, H, W), premultiplied colour and coverage
  const float* background;  // (B, 3)
  const float* scale;       // (B) of the error of the latent
  const float* weight;      // (B) of the gradient
  int64_t items, height, width;
  int32_t threads;
  float slope;  // what the gradient of the latent is multiplied by for that of the render
};

struct SplatKnownGradient {
  float* gradient;  // (B, H, W, 3), with respect to the render
  double* squares;  // (B, H), squares of that with respect to the latent 2 render - 1, summed over a row
};

#pragma GCC visibility push(default)
extern "C" {
// 0, or the bytes of memory that would have been needed. If `state` is not null, it receives what a backward pass needs, to be
// freed by `splat_release`.
int64_t splat_forward(const splat::Scene*, const SplatSettings*, const SplatPictures*, SplatState** state);
int64_t splat_backward(SplatState*, const splat::Scene*, const SplatSettings*, const SplatUpstream*, const SplatGradients*);
void splat_release(SplatState*);  // null is ignored
// SPLAT_INTERFACE of the source that this library was built from.
int32_t splat_interface();
// Limits what a call may take; the memory of the machine or its container.
void splat_set_memory(int64_t bytes);
int64_t splat_gradients_to_pictures(const SplatKnownPictures*, const SplatKnownGradient*);
// The best build for this processor: "v4", "v3" or "base".
const char* splat_best_isa();
}
#pragma GCC visibility pop
