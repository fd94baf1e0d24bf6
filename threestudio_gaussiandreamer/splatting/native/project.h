// Stage 1: Gaussians to splats, and which tiles each splat touches.
#pragma once

#include <cmath>

#include "interleaved.h"
#include "view.h"

namespace splat {

inline Camera make_camera(const SplatScene& scene, int view) {
  const float* v = scene.viewmats + 16 * view;
  const float* k = scene.Ks + 9 * view;
  const float width = scene.width, height = scene.height, margin_x = 0.15f * width / k[0], margin_y = 0.15f * height / k[4];
  Camera c;
  c.rotation = {{v[0], v[1], v[2]}, {v[4], v[5], v[6]}, {v[8], v[9], v[10]}};
  c.translation = {v[3], v[7], v[11]};
  c.focal = {k[0], k[4]};
  c.centre = {k[2], k[5]};
  c.slope_low = {-k[2] / k[0] - margin_x, -k[5] / k[4] - margin_y};
  c.slope_high = {(width - k[2]) / k[0] + margin_x, (height - k[5]) / k[4] + margin_y};
  c.size = {width, height};
  return c;
}

struct Gaussians {
  Vec3<Floats> means, scales;
  Vec4<Floats> quats;
  Floats opacities;
};

SPLAT_FN Vec3<Floats> load_vec3(const float* p, int count) { return load_items<3>(p, count, load3<Floats>); }

SPLAT_FN Floats load_scalars(const float* p, int count) { return load_items<1>(p, count, load<Floats>); }

SPLAT_FN Gaussians load_gaussians(const SplatScene& scene, int64_t first, int count) {
  return {load_vec3(scene.means + 3 * first, count), load_vec3(scene.scales + 3 * first, count), load_items<4>(scene.quats + 4 * first, count, load4),
          load_scalars(scene.opacities + first, count)};
}

inline const float* colors_of(const SplatScene& scene, int view) { return scene.colors + (scene.colors_per_view ? 3 * scene.gaussians * view : 0); }

// Everything about one vector of Gaussians in one view; the backward pass computes it again.
struct Projection {
  Vec3<Floats> t;
  Mat3<Floats> axes;
  Screen<Floats> screen;
  Whitening<Floats> whitening;
};

SPLAT_FN Projection project(const Camera& camera, const Vec3<Floats>& means, const Mat3<Floats>& axes_in_world, float eps2d) {
  Projection p;
  p.t = to_camera(camera, means);
  p.axes = multiply(camera.rotation, axes_in_world);
  p.screen = to_screen(camera, p.t, p.axes);
  p.whitening = whiten(p.screen.u0, p.screen.u1, eps2d);
  return p;
}

SPLAT_FN Ints all_finite(const Gaussians& g, const Vec3<Floats>& colors) {
  const Vec3<Floats> sum = 0.0f * g.means + 0.0f * g.scales + 0.0f * colors;
  return finite(sum.x + sum.y + sum.z + 0.0f * g.quats.w + 0.0f * g.quats.x + 0.0f * g.quats.y + 0.0f * g.quats.z + 0.0f * g.opacities);
}

// In front of the camera, representable, opaque enough for a pixel, and with a box that meets the image.
SPLAT_FN Ints visible_lanes(const Camera& camera, const SplatSettings& settings, const Projection& p, Floats level, const Vec2<Floats>& extent) {
  const Whitening<Floats>& w = p.whitening;
  const Vec2<Floats>& mean = p.screen.mean;
  const Ints in_range = (p.t.z > settings.near) & (p.t.z < settings.far) & (level >= 0.0f);
  const Ints drawable = finite(w.a) & finite(w.b) & finite(w.c) & finite(mean.x) & finite(mean.y) & (w.a > 0.0f) & (w.c > 0.0f);
  const Ints in_columns = (mean.x + extent.x >= 0.0f) & (mean.x - extent.x <= camera.size.x);
  const Ints in_rows = (mean.y + extent.y >= 0.0f) & (mean.y - extent.y <= camera.size.y);
  return in_range & drawable & in_columns & in_rows;
}

// Tiles along one axis of the pixels whose centres lie within centre +- extent, a little more to be safe.
struct TileRange {
  int32_t first[LANES], last[LANES];
};

SPLAT_FN TileRange tile_range(Floats centre, Floats extent, float size) {
  const Floats zero = {}, end = zero + (size - 1.0f), reach = extent + 1e-3f;
  TileRange range;
  const Ints first = __builtin_convertvector(clamp(centre - reach + 0.5f, zero, end) * (1.0f / TILE), Ints);
  const Ints last = __builtin_convertvector(clamp(centre + reach - 0.5f, zero, end) * (1.0f / TILE), Ints);
  std::memcpy(range.first, &first, sizeof first);
  std::memcpy(range.last, &last, sizeof last);
  return range;
}

// Columns [first, last] cut down to those that the ellipse meets in one row of tiles.
inline TileSpan cut_span(const Splat& s, int row, int first, int last) {
  const float top = row * TILE + 0.5f - s.y;
  const Span<float> x = row_span(s, top, top + (TILE - 1));
  const float low = clamp(s.x + x.low - 0.501f, 0.0f, float(last * TILE)), high = clamp(s.x + x.high - 0.499f, -1.0f, float(last * TILE));
  const int begin = std::max(first, int(std::ceil(low)) / TILE), end = high < 0 ? begin : std::max(begin, int(high) / TILE + 1);
  return {uint16_t(begin), uint16_t(std::min(end, std::max(begin, last + 1)))};
}

// Appends the tiles of a splat within columns [x0, x1] and rows [y0, y1] to its slice. The exact cut pays from six tiles on.
inline Coverage cover(const Splat& splat, int x0, int x1, int y0, int y1, Slice& slice) {
  const int32_t first_slot = int32_t(slice.slots), first_span = int32_t(slice.spans.size());
  const bool cut = x1 > x0 && y1 > y0 && (x1 - x0 + 1) * (y1 - y0 + 1) >= 6;
  for (int y = y0; y <= y1; y++) {
    const TileSpan span = cut ? cut_span(splat, y, x0, x1) : TileSpan{uint16_t(x0), uint16_t(x1 + 1)};
    slice.spans.push_back(span);
    slice.slots += span.end - span.begin;
  }
  return {first_slot, int32_t(slice.slots - first_slot), first_span, uint16_t(y0), uint16_t(y1 - y0 + 1)};
}

// A depth key orders as the depth does: positive floats compare like their bits.
inline uint64_t depth_key(float depth, int64_t gaussian) {
  uint32_t bits;
  std::memcpy(&bits, &depth, sizeof bits);
  return uint64_t(bits) << 32 | uint64_t(gaussian);
}

SPLAT_FN void store_splats(const Projection& p, Floats log2_opacity, Floats level, const Vec2<Floats>& extent, const Vec3<Floats>& colors, Splat* splats) {
  const Whitening<Floats>& w = p.whitening;
  const Floats a = w.a * WHITENING_SCALE, b = w.b * WHITENING_SCALE, c = w.c * WHITENING_SCALE;
  Floats columns[ROW] = {p.screen.mean.x, p.screen.mean.y, a, b, c, log2_opacity, p.t.z, colors.x, colors.y, colors.z,
                         1.0f / a, w.xy / w.yy, extent.x * w.xy / w.xx, extent.x, extent.y, level};
  store_columns(columns, reinterpret_cast<float*>(splats));
}

SPLAT_FN void store_screen(const SplatPictures& out, int64_t at, int count, const Projection& p, const Vec2<Floats>& extent, Ints visible) {
  const Floats zero = {};
  const Floats x = select(visible, p.screen.mean.x, zero), y = select(visible, p.screen.mean.y, zero);
  const Floats radius = select(visible, maximum(extent.x, extent.y), zero);
  for (int l = 0; l < count; l++) out.means2d[2 * (at + l)] = x[l], out.means2d[2 * (at + l) + 1] = y[l];
  store_items<1>(out.radii + at, count, [&](float* q) { store(q, radius); });
  store_items<1>(out.contribution + at, count, [&](float* q) { store(q, zero); });
}

// LANES Gaussians from `first` on, of which `count` exist.
inline void project_lanes(const SplatScene& scene, const SplatSettings& settings, const SplatPictures& out, View& view, Slice& slice, int64_t first, int count) {
  const Gaussians g = load_gaussians(scene, first, count);
  const Vec3<Floats> colors = load_vec3(colors_of(scene, view.index) + 3 * first, count);
  const Projection p = project(view.camera, g.means, world_axes(quat_to_rotation(g.quats).matrix, g.scales), settings.eps2d);
  const Floats opacity = settings.antialias ? g.opacities * p.whitening.compensation : g.opacities;
  const Floats log2_opacity = log2(maximum(opacity, Floats{} + 1e-37f)), level = log2_opacity - std::log2(settings.alpha_min);
  const Vec2<Floats> extent = extents(p.whitening, level);
  const Ints visible = all_finite(g, colors) & visible_lanes(view.camera, settings, p, level, extent);
  store_splats(p, log2_opacity, level, extent, colors, view.splats.data() + first);
  store_screen(out, view.index * scene.gaussians + first, count, p, extent, visible);

  const TileRange x = tile_range(p.screen.mean.x, extent.x, view.camera.size.x), y = tile_range(p.screen.mean.y, extent.y, view.camera.size.y);
  uint64_t* keys = view.keys.data() + first / SLICE * SLICE;
  for (int l = 0; l < count; l++) {
    view.coverage[first + l] = visible[l] ? cover(view.splats[first + l], x.first[l], x.last[l], y.first[l], y.last[l], slice) : Coverage{};
    if (visible[l]) keys[slice.visible++] = depth_key(view.splats[first + l].depth, first + l);
  }
}

inline void project_slice(const SplatScene& scene, const SplatSettings& settings, const SplatPictures& out, View& view, int64_t index) {
  Slice& slice = view.slices[index];
  slice.spans.clear(), slice.slots = 0, slice.visible = 0;
  const int64_t end = std::min<int64_t>(scene.gaussians, (index + 1) * SLICE);
  for (int64_t first = index * SLICE; first < end; first += LANES)
    project_lanes(scene, settings, out, view, slice, first, int(std::min<int64_t>(LANES, end - first)));
}

}  // namespace splat
