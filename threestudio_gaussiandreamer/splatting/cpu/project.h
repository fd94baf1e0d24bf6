// Stage 1: project Gaussians to splats, and find the tiles that each splat overlaps.
#pragma once

#include "calls.h"
#include "interleaved.h"
#include "splat_view.h"

namespace splat {

SPLAT_FN Vec3<Floats> load_vec3(const float* p, int count) { return load_items<3>(p, count, load3<Floats>); }

SPLAT_FN Floats load_scalars(const float* p, int count) { return load_items<1>(p, count, load<Floats>); }

SPLAT_FN Gaussian<Floats> load_gaussians(const Scene& scene, const SplatSettings& settings, Group group) {
  const auto [first, count] = group;
  const Floats opacities = load_scalars(scene.opacities + first, count);
  return {load_vec3(scene.means + 3 * first, count), load_vec3(scene.scales + 3 * first, count),
          load_items<4>(scene.quats + 4 * first, count, load4), drawn_opacity(opacities, std::log2(settings.alpha_min))};
}

SPLAT_FN Vec3<Floats> load_colors(const Scene& scene, int view, Group group) {
  const int64_t offset = scene.colors_per_view ? scene.gaussians * view : 0;
  return load_vec3(scene.colors + 3 * (offset + group.first), group.count);
}

// Tiles, SIDE pixels each, along one axis of the pixels whose centres lie within centre +- extent, a little more to be safe.
struct TileRange {
  Ints first, last;
};

template <int SIDE> SPLAT_FN TileRange tile_range(Floats centre, Floats extent, float size) {
  const Floats zero = {}, end = zero + (size - 1.0f), reach = extent + 1e-3f;
  return {__builtin_convertvector(clamp(centre - reach + 0.5f, zero, end) * (1.0f / SIDE), Ints),
          __builtin_convertvector(clamp(centre + reach - 0.5f, zero, end) * (1.0f / SIDE), Ints)};
}

inline Ellipse<float> ellipse_of(const Splat& s) {
  return {s.x, s.y, s.extent_y, s.c * s.c, s.level, s.inverse_a, s.tilt, s.slant};
}

// Columns [first, last] of tiles cut down to those that the ellipse meets in one row of tiles, with a safety margin.
inline TileSpan cut_span(const Ellipse<float>& ellipse, int row, int first, int last) {
  const float top = row * TILE_HEIGHT + 0.5f;
  const Span<float> x = row_span(ellipse, top, top + (TILE_HEIGHT - 1));
  const float end_x = float(last * TILE_WIDTH);
  const float low = clamp(x.low - 0.501f, 0.0f, end_x), high = clamp(x.high - 0.499f, -1.0f, end_x);
  const int begin = std::max(first, int(std::ceil(low)) / TILE_WIDTH), end = high < 0 ? begin : int(high) / TILE_WIDTH + 1;
  return {uint16_t(begin), uint16_t(std::max(begin, std::min(end, last + 1)))};
}

inline Coverage no_coverage(const Slice& slice) { return {int32_t(slice.slots), 0, 0, 0, {0, 0}}; }

// The tiles of a splat within columns [x0, x1] and rows [y0, y1]. Cutting the rows exactly pays from six tiles on.
inline Coverage cover(const Splat& splat, int x0, int x1, int y0, int y1, Slice& slice) {
  if (x1 < x0 || y1 < y0) return no_coverage(slice);
  const int columns = x1 - x0 + 1, rows = y1 - y0 + 1;
  const Coverage box = {
      int32_t(slice.slots), int32_t(slice.spans.size()), uint16_t(y0), uint16_t(rows), {uint16_t(x0), uint16_t(x1 + 1)}};
  if (columns == 1 || rows == 1 || columns * rows < 6) {
    slice.slots += columns * rows;
    return box;
  }
  const Ellipse<float> ellipse = ellipse_of(splat);
  for (int y = y0; y <= y1; y++) {
    slice.spans.push_back(cut_span(ellipse, y, x0, x1));
    slice.slots += slice.spans.back().end - slice.spans.back().begin;
  }
  return {box.slot, box.span, box.row, box.rows, {0, 0}};
}

// A depth key orders as the depth does: positive floats compare like their bits.
inline uint64_t depth_key(float depth, int64_t gaussian) {
  uint32_t bits;
  std::memcpy(&bits, &depth, sizeof bits);
  return uint64_t(bits) << 32 | uint64_t(gaussian);
}

SPLAT_FN void store_splats(const Projection<Floats>& p, const Reach<Floats>& reach, const Vec3<Floats>& colors, Splat* splats) {
  Floats columns[ROW];
  splat_columns(p, reach, colors, columns);
  store_columns(columns, &splats->x);
}

// Means and radii of the visible lanes, zeros elsewhere.
SPLAT_FN void store_screen(const ForwardCall& call, int view, Group group, const Projection<Floats>& p, const Reach<Floats>& reach,
                           Ints visible) {
  const int64_t at = view * call.scene.gaussians + group.first;
  const Floats zero = {}, radius = select(visible, maximum(reach.extent.x, reach.extent.y), zero);
  const Vec2<Floats> mean = {select(visible, p.screen.mean.x, zero), select(visible, p.screen.mean.y, zero)};
  store_items<2>(call.out.means2d + 2 * at, group.count, [&](float* q) { store2(q, mean); });
  store_items<1>(call.out.radii + at, group.count, [&](float* q) { store(q, radius); });
}

// Stores the tiles and the depth of the visible lanes, and counts them by tile where one thread sees all of them.
inline void list_lanes(View& view, Slice& slice, Group group, const Projection<Floats>& p, const Reach<Floats>& reach, Ints visible) {
  const TileRange x = tile_range<TILE_WIDTH>(p.screen.mean.x, reach.extent.x, view.camera.size.x);
  const TileRange y = tile_range<TILE_HEIGHT>(p.screen.mean.y, reach.extent.y, view.camera.size.y);
  uint64_t* keys = view.keys.data() + group.first / SLICE * SLICE;
  for (int l = 0; l < group.count; l++) {
    const int64_t gaussian = group.first + l;
    const Splat& splat = view.splats[gaussian];
    view.coverage(gaussian) = visible[l] ? cover(splat, x.first[l], x.last[l], y.first[l], y.last[l], slice) : no_coverage(slice);
    if (!visible[l]) continue;
    keys[slice.visible++] = depth_key(splat.depth, gaussian);
    if (view.counted) for_each_tile(view, gaussian, [&](int tile) { view.histogram[tile]++; });
  }
}

inline void project_group(const ForwardCall& call, View& view, Slice& slice, Group group) {
  const SplatSettings& settings = call.settings;
  const Gaussian<Floats> g = load_gaussians(call.scene, settings, group);
  const Vec3<Floats> colors = load_colors(call.scene, view.index, group);
  const Mat3<Floats> axes = world_axes(quat_to_rotation(g.quat).matrix, g.scale);
  const Projection<Floats> p = project(view.camera, g.mean, axes, settings.eps2d);
  const Reach<Floats> reach = reach_of(p, g.opacity, settings.antialias, std::log2(settings.alpha_min));
  const Ints visible = all_finite(g, colors) & is_visible(view.camera, p, reach, settings.near, settings.far);
  store_splats(p, reach, colors, view.splats.data() + group.first);
  store_screen(call, view.index, group, p, reach, visible);
  list_lanes(view, slice, group, p, reach, visible);
}

inline void project_slice(const ForwardCall& call, View& view, int64_t index) {
  Slice& slice = view.slices[index];
  slice.spans.clear(), slice.slots = 0, slice.visible = 0;
  const int64_t end = std::min<int64_t>(call.scene.gaussians, (index + 1) * SLICE);
  for_each_group(index * SLICE, end, [&](Group group) { project_group(call, view, slice, group); });
  (&view.coverage(end - 1))[1] = no_coverage(slice);
  // more intersections can't be numbered: number_slots refuses the view, and needs no counts by tile
  if (view.counted) view.counted = (view.intersection_count += slice.slots) <= INT32_MAX;
}

}  // namespace splat
