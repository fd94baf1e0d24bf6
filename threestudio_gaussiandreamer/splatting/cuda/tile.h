// Shared by the forward and the backward blend: the list of a tile, its splats staged in shared memory, and a warp's pixels.
#pragma once

#include "reach.h"

namespace splat {

constexpr int CHUNK = 128, GROUPS = CHUNK / WARP;  // splats staged at a time

// All tile intersections of all views, the result of stages 1 to 5.
struct Lists {
  const Splat* splats;    // (B, N)
  const Index* order;     // (B, N) Gaussians front to back
  const Index* ends;      // (B, N) running sum of the counts; the last one is how many there should be
  const int* owners;      // (capacity) view * N + Gaussian
  const Index* sorted;    // (capacity) which of them, by tile
  const Index* begins;    // (B * tiles + 1) into `sorted`
  Index capacity;
};

struct TileFrame {
  int view, left, top;
  Index begin, end;   // of the list
  bool unlisted;      // the intersections didn't fit: every Gaussian of the view is on the list
};

SPLAT_FN TileFrame frame_of(const Scene& scene, const Lists& lists) {
  const int tiles_x = tiles_along(scene.width), tiles = tiles_x * tiles_along(scene.height), tile = blockIdx.x, view = blockIdx.y;
  const int left = tile % tiles_x * TILE, top = tile / tiles_x * TILE;
  const bool unlisted = lists.ends[Index(scene.views) * scene.gaussians - 1] > lists.capacity;
  if (unlisted) return {view, left, top, 0, scene.gaussians, true};
  const Index at = Index(view) * tiles + tile;
  return {view, left, top, lists.begins[at], lists.begins[at + 1], false};
}

// view * N + Gaussian of item `i` of a list.
SPLAT_FN Index owner_of(const Scene& scene, const Lists& lists, const TileFrame& frame, Index i) {
  if (!frame.unlisted) return lists.owners[lists.sorted[i]];
  const Index first = Index(frame.view) * scene.gaussians;
  return first + lists.order[first + i];
}

// y = (a X + b Y + shift_x, c Y + shift_y) at pixel (X, Y) of the tile; log2(alpha) = log2_opacity - |y|^2.
struct alignas(16) LocalSplat {
  float a, b, c, shift_x, shift_y, log2_opacity;
  float red, green, blue, depth, spare_1, spare_2;
};

// a b + c, always rounded once. Values that are compared with thresholds use it, so that the backward pass makes the forward
// pass's decisions to the bit: a compiler may fuse the same expression differently in two kernels.
SPLAT_FN float multiply_add(float a, float b, float c) { return __fmaf_rn(a, b, c); }

SPLAT_FN LocalSplat to_tile(const Splat& s, const TileFrame& frame) {
  const float x = s.x - frame.left, y = s.y - frame.top;
  return {s.a, s.b, s.c, -multiply_add(s.a, x, s.b * y), -s.c * y, s.log2_opacity, s.red, s.green, s.blue, s.depth, 0.0f, 0.0f};
}

// Bit PATCHES_PER_ROW r + c is set when the ellipse comes near a pixel centre of patch (r, c).
SPLAT_FN unsigned patches_of(const Splat& splat, const TileFrame& frame) {
  if (!(splat.level >= 0.0f)) return 0;
  const Range rows = rows_of(splat, float(frame.top), PATCH_HEIGHT, TILE / PATCH_HEIGHT);
  unsigned mask = 0;
  for (int row = rows.begin; row < rows.end; row++) {
    const float top = frame.top + row * PATCH_HEIGHT;
    const Range columns = columns_of(splat, float(frame.left), top, PATCH_WIDTH, PATCH_HEIGHT, PATCHES_PER_ROW);
    for (int column = columns.begin; column < columns.end; column++) mask |= 1u << (row * PATCHES_PER_ROW + column);
  }
  return mask;
}

struct Stage {
  LocalSplat splats[CHUNK];
  unsigned hits[GROUPS][PATCHES];  // bit j of hits[g][p]: splat 32 g + j reaches patch p
};

// Three wide reads that a whole warp shares.
SPLAT_FN LocalSplat load_staged(const Stage& stage, int slot) {
  LocalSplat splat;
  copy_quads(stage.splats[slot], splat);
  return splat;
}

// Fills the stage with items [first, first + count) of the list; returns the owner of this thread's one, or -1. The caller
// puts barriers between this and the reads of the stage.
SPLAT_FN Index fill_stage(Stage& stage, const Scene& scene, const Lists& lists, const TileFrame& frame, Index first, int count) {
  const int slot = threadIdx.x;
  Index owner = -1;
  if (slot >= CHUNK) return owner;  // whole warps
  unsigned mask = 0;
  if (slot < count) {
    owner = owner_of(scene, lists, frame, first + slot);
    Splat splat;
    copy_quads(lists.splats[owner], splat);
    stage.splats[slot] = to_tile(splat, frame);
    mask = patches_of(splat, frame);
  }
  for (int patch = 0; patch < PATCHES; patch++) {
    const unsigned hits = __ballot_sync(FULL, mask >> patch & 1);
    if (slot % WARP == patch) stage.hits[slot / WARP][patch] = hits;
  }
  return owner;
}

// The pixel of this thread.
struct Pixel {
  int patch, lane, x, y;  // in the image
  bool inside;
  float local_x, local_y;    // its centre in the tile
  float corner_x, corner_y;  // centre of the patch's first pixel
};

SPLAT_FN Pixel pixel_of(const Scene& scene, const TileFrame& frame) {
  Pixel p;
  p.patch = threadIdx.x / WARP, p.lane = threadIdx.x % WARP;
  const int left = p.patch % PATCHES_PER_ROW * PATCH_WIDTH, top = p.patch / PATCHES_PER_ROW * PATCH_HEIGHT;
  const int column = p.lane % PATCH_WIDTH, row = p.lane / PATCH_WIDTH;
  p.x = frame.left + left + column, p.y = frame.top + top + row;
  p.inside = p.x < scene.width && p.y < scene.height;
  p.corner_x = left + 0.5f, p.corner_y = top + 0.5f;
  p.local_x = p.corner_x + column, p.local_y = p.corner_y + row;
  return p;
}

// A pixel's colour and depth in front of the background, and its transmittance.
struct Sums {
  Quad color_depth;
  float transmittance;
};

// log2(alpha) of a splat at a pixel, before cap and threshold.
SPLAT_FN float power_at(const LocalSplat& s, float x, float y) {
  const float y1 = multiply_add(s.a, x, multiply_add(s.b, y, s.shift_x)), y2 = multiply_add(s.c, y, s.shift_y);
  return multiply_add(-y2, y2, multiply_add(-y1, y1, s.log2_opacity));
}

// What a pixel's transmittance becomes behind a splat; a stopped pixel keeps it.
SPLAT_FN float transmit(float alpha, float transmittance, float stop) {
  return transmittance >= stop ? multiply_add(-alpha, transmittance, transmittance) : transmittance;
}

}  // namespace splat
