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

// Of the columns of tiles of a box, those that the ellipse meets in one row of tiles, with a safety margin.
inline TileSpan cut_span(const Ellipse<float>& ellipse, int row, TileSpan columns) {
  const float top = row * TILE_HEIGHT + 0.5f;
  const Span<float> x = row_span(ellipse, top, top + (TILE_HEIGHT - 1));
  const float end_x = float((columns.end() - 1) * TILE_WIDTH);
  const float low = clamp(x.low - 0.501f, 0.0f, end_x), high = clamp(x.high - 0.499f, -1.0f, end_x);
  const int begin = std::max(columns.begin(), int(std::ceil(low)) / TILE_WIDTH);
  const int end = high < 0 ? begin : int(high) / TILE_WIDTH + 1;
  return tile_span(begin, std::max(begin, std::min(end, columns.end())));
}

// The rows and columns of tiles that the boxes around LANES ellipses meet.
struct TileBoxes {
  Ints left, top, columns, rows;
};

SPLAT_FN TileBoxes tile_boxes(const Camera& camera, const Screen<Floats>& screen, const Reach<Floats>& reach, Ints visible) {
  const TileRange x = tile_range<TILE_WIDTH>(screen.mean.x, reach.extent.x, camera.size.x);
  const TileRange y = tile_range<TILE_HEIGHT>(screen.mean.y, reach.extent.y, camera.size.y);
  const Ints drawn = visible & (x.last >= x.first) & (y.last >= y.first);
  return {x.first & drawn, y.first & drawn, (x.last - x.first + 1) & drawn, (y.last - y.first + 1) & drawn};
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

// Cuts down the boxes that have six tiles or more, as then it pays; returns the number of tiles in each lane.
inline Ints cut_boxes(const View& view, const TileBoxes& box, Slice& slice, Group group, Ints& spans) {
  Ints tiles = box.columns * box.rows;
  const Ints large = (box.columns > 1) & (box.rows > 1) & (tiles >= 6);
  if (!any_lane(large)) return tiles;
  for (int l = 0; l < group.count; l++) {
    if (!large[l]) continue;
    spans[l] = int32_t(slice.spans.size()), tiles[l] = 0;
    const Ellipse<float> ellipse = ellipse_of(view.splats[group.first + l]);
    for (int y = box.top[l]; y < box.top[l] + box.rows[l]; y++) {
      slice.spans.push_back(cut_span(ellipse, y, tile_span(box.left[l], box.left[l] + box.columns[l])));
      tiles[l] += slice.spans.back().size();
    }
  }
  return tiles;
}

// Stores the tiles of the lanes, none where they aren't visible, and counts them where one thread sees all of them.
inline void list_tiles(View& view, Slice& slice, Group group, const TileBoxes& box) {
  Ints spans = Ints{} - 1, slots = {};
  const Ints tiles = cut_boxes(view, box, slice, group, spans);
  for (int l = 0; l < LANES; l++) slots[l] = int32_t(slice.slots), slice.slots += tiles[l];
  const Ints rows = (box.top + box.rows) << 16 | box.top, columns = (box.left + box.columns) << 16 | box.left;
  const Vec4<Floats> words = {(Floats)slots, (Floats)spans, (Floats)rows, (Floats)columns};
  store_items<4>(reinterpret_cast<float*>(&view.coverage(group.first)), group.count, [&](float* p) { store4(p, words); });
  if (view.counted)
    for (int l = 0; l < group.count; l++) add_corners(view, group.first + l, view.histogram.data());
}

inline void list_keys(View& view, Slice& slice, Group group, Floats depth, Ints visible) {
  uint64_t* keys = view.keys.data() + group.first / SLICE * SLICE;
  int32_t count = slice.visible;
  for (int l = 0; l < group.count; l++) {
    keys[count] = depth_key(depth[l], group.first + l);
    count += visible[l] & 1;  // without a branch, which would be mispredicted; the next one replaces a key that isn't counted
  }
  slice.visible = count;
}

inline void project_group(const ForwardCall& call, View& view, Slice& slice, Group group) {
  const SplatSettings& settings = call.settings;
  const Gaussian<Floats> g = load_gaussians(call.scene, settings, group);
  const Vec3<Floats> colors = load_colors(call.scene, view.index, group);
  const Mat3<Floats> axes = world_axes(quat_to_rotation(g.quat).matrix, g.scale);
  const Projection<Floats> p = project(view.camera, g.mean, axes, settings.eps2d);
  const Reach<Floats> reach = reach_of(p, g.opacity, settings.antialias, std::log2(settings.alpha_min));
  const Ints drawable = (lane_numbers() < group.count) & all_finite(g, colors);
  const Ints visible = drawable & is_visible(view.camera, p, reach, settings.near, settings.far);
  store_splats(p, reach, colors, view.splats.data() + group.first);
  store_screen(call, view.index, group, p, reach, visible);
  list_tiles(view, slice, group, tile_boxes(view.camera, p.screen, reach, visible));
  list_keys(view, slice, group, p.t.z, visible);
}

inline void project_slice(const ForwardCall& call, View& view, int64_t index) {
  Slice& slice = view.slices[index];
  slice.spans.clear(), slice.slots = 0, slice.visible = 0;
  const int64_t end = std::min<int64_t>(call.scene.gaussians, (index + 1) * SLICE);
  for_each_group(index * SLICE, end, [&](Group group) { project_group(call, view, slice, group); });
  (&view.coverage(end - 1))[1] = {int32_t(slice.slots), -1, {0}, {0}};
}

}  // namespace splat
