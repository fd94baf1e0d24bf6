// Parameters of all kernels, and the keywords that differ between NVRTC and a host compiler that runs these files in tests.
#pragma once

#define SPLAT_FN static __device__ __forceinline__
#include "splat_view.h"

namespace splat {

using Index = long long;  // views times Gaussians, pixels or intersections: may not fit 32 bits

constexpr unsigned FULL = 0xffffffffu;  // all lanes of a warp
constexpr int WARP = 32;

// A tile is a block of 8 warps; a warp is 8 x 4 pixels of it.
constexpr int TILE = 16, TILE_PIXELS = TILE * TILE;
constexpr int PATCH_WIDTH = 8, PATCH_HEIGHT = 4, PATCHES_PER_ROW = TILE / PATCH_WIDTH, PATCHES = TILE_PIXELS / WARP;

constexpr int CULLED = 0x7fffffff;  // depth key behind all others

struct Settings {
  float near, far, eps2d, log2_alpha_min, alpha_max, stop;
  int antialias, downsample;
};

SPLAT_FN int tiles_along(int pixels) { return (pixels + TILE - 1) / TILE; }

// Four floats that are read or written as one.
struct alignas(16) Quad {
  float x, y, z, w;
};

SPLAT_FN Quad operator+(const Quad& a, const Quad& b) { return {a.x + b.x, a.y + b.y, a.z + b.z, a.w + b.w}; }

template <class T> SPLAT_FN void copy_quads(const T& from, T& to) {
  const Quad* source = reinterpret_cast<const Quad*>(&from);
  Quad* target = reinterpret_cast<Quad*>(&to);
  for (int i = 0; i < int(sizeof(T) / sizeof(Quad)); i++) target[i] = source[i];
}

// The sums of a splat over the pixels of a tile: what the backward blend hands to the adjoint of the projection.
struct alignas(16) Row {
  float sums[SUMS];
};
constexpr int ROW_QUADS = sizeof(Row) / sizeof(Quad);

SPLAT_FN Vec3<float> load3(const float* p) { return {p[0], p[1], p[2]}; }
SPLAT_FN void store3(float* p, const Vec3<float>& v) { p[0] = v.x, p[1] = v.y, p[2] = v.z; }

SPLAT_FN Gaussian<float> load_gaussian(const Scene& scene, const Settings& settings, Index i) {
  const float opacity = drawn_opacity(scene.opacities[i], settings.log2_alpha_min);
  const float* q = scene.quats + 4 * i;
  return {load3(scene.means + 3 * i), load3(scene.scales + 3 * i), {q[0], q[1], q[2], q[3]}, opacity};
}

SPLAT_FN const float* color_of(const Scene& scene, int view, Index gaussian) {
  return scene.colors + 3 * (scene.colors_per_view ? Index(view) * scene.gaussians + gaussian : gaussian);
}

}  // namespace splat
