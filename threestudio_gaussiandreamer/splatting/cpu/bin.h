// Stages 2 and 3: sort the visible Gaussians by depth, then assign them to the tiles in that order.
#pragma once

#include "parallel.h"
#include "project.h"

namespace splat {

constexpr int DIGIT_BITS = 12;

// One pass of a radix sort: stable, by the digit that `digit(item)` gives.
template <class Digit> SPLAT_FN void sort_by_digit(const uint64_t* items, uint64_t* sorted, int64_t count, Digit digit) {
  int32_t begin[1 << DIGIT_BITS] = {};
  for (int64_t i = 0; i < count; i++) begin[digit(items[i])]++;
  int32_t sum = 0;
  for (int32_t& b : begin) {
    const int32_t here = b;
    b = sum, sum += here;
  }
  for (int64_t i = 0; i < count; i++) sorted[begin[digit(items[i])]++] = items[i];
}

// Stable sort by the upper 32 bits, which lie in [lowest, highest]. Returns whichever of the two arrays holds the result.
inline uint64_t* radix_sort(uint64_t* items, uint64_t* spare, int64_t count, uint32_t lowest, uint32_t highest) {
  for (int shift = 0; (uint64_t(highest - lowest) >> shift) != 0; shift += DIGIT_BITS) {
    sort_by_digit(items, spare, count,
                  [=](uint64_t item) { return (uint32_t(item >> 32) - lowest) >> shift & ((1 << DIGIT_BITS) - 1); });
    std::swap(items, spare);
  }
  return items;
}

// Closes the gaps between the slices' keys; returns the number of visible Gaussians.
inline int64_t gather_keys(View& view) {
  uint64_t* end = view.keys.data();
  for (size_t i = 0; i < view.slices.size(); i++) {
    const uint64_t* first = view.keys.data() + i * SLICE;
    end = std::copy(first, first + view.slices[i].visible, end);
  }
  return end - view.keys.data();
}

// (depth, index) order of the visible Gaussians; the lower halves of the keys are the indices.
inline const uint64_t* sort_by_depth(View& view, int64_t visible) {
  uint32_t lowest = ~0u, highest = 0;
  for (int64_t i = 0; i < visible; i++) {
    const uint32_t depth = uint32_t(view.keys[i] >> 32);
    lowest = std::min(lowest, depth), highest = std::max(highest, depth);
  }
  return visible ? radix_sort(view.keys.data(), view.spare_keys.data(), visible, lowest, highest) : view.keys.data();
}

// The visible Gaussians in the order of their depth, in parts of equal size.
struct DepthOrder {
  const uint64_t* keys;  // the lower halves are the Gaussians
  int64_t visible;
  int parts;
};

// Calls visit(gaussian) for one part, in order.
template <class Visit> SPLAT_FN void for_each_of_part(const View& view, const DepthOrder& order, int64_t part, Visit visit) {
  const int64_t end = order.visible * (part + 1) / order.parts;
  for (int64_t i = order.visible * part / order.parts; i < end; i++) {
    __builtin_prefetch(&view.coverage(uint32_t(order.keys[std::min(i + 24, end - 1)])));
    visit(uint32_t(order.keys[i]));
  }
}

// What intersections take: they and their peaks, and for a backward pass their lists, gradients and share of the transmittance.
inline int64_t bytes_of(int64_t intersections, bool keep) {
  const int64_t drawn = sizeof(Intersection) + sizeof(float);
  const int64_t kept = sizeof(uint16_t) * KEPT_PAIRS + sizeof(float) * (ROW + TILE_PIXELS / CHUNK);
  return intersections * (drawn + (keep ? kept : 0));
}

// Sets each slice's first slot and the number of intersections.
inline void number_slots(View& view, bool keep) {
  view.intersection_count = 0;
  for (Slice& slice : view.slices) slice.first_slot = int32_t(view.intersection_count), view.intersection_count += slice.slots;
  check_memory(bytes_of(view.intersection_count, keep));
  if (view.intersection_count > INT32_MAX - CHUNK) throw OutOfMemory{view.intersection_count * int64_t(sizeof(float) * ROW)};
}

inline void count_tiles(View& view, const DepthOrder& order, int64_t part) {
  int32_t* corners = view.histogram.data() + part * view.corners();
  std::fill_n(corners, view.corners(), 0);
  for_each_of_part(view, order, part, [&](uint32_t gaussian) { add_corners(view, gaussian, corners); });
  sum_corners(view, corners);
}

// Converts the counts per (part, tile) to the position of each part's first intersection of each tile.
inline void scan_histogram(View& view, int parts) {
  int32_t sum = 0;
  for (int tile = 0; tile < view.tiles(); tile++) {
    view.tile_begin[tile] = sum;
    for (int part = 0; part < parts; part++) {
      int32_t& here = view.histogram[size_t(part) * view.corners() + tile];
      const int32_t count = here;
      here = sum, sum += count;
    }
  }
  view.tile_begin[view.tiles()] = sum;
}

// Puts a Gaussian into its 1 to 2 x 2 tiles by four writes, since branches on their number would be mispredicted. Where there are
// fewer tiles, some are written twice, at the same position, and the right slot is written last.
SPLAT_FN void fill_four(const View& view, int32_t gaussian, const Coverage& c, int32_t slot, int32_t* next, Intersection* items) {
  const int columns = c.columns.size(), first = c.rows.begin() * view.tiles_x + c.columns.begin();
  const int right = columns - 1, below = (c.rows.size() - 1) * view.tiles_x;
  const int tiles[4] = {first, first + right, first + below, first + below + right};
  const int32_t slots[4] = {slot, slot + 1, slot + columns, slot + columns + 1};
  int32_t at[4];
  for (int i = 0; i < 4; i++) at[i] = next[tiles[i]];
  for (int i = 0; i < 4; i++) __builtin_prefetch(items + at[i] + 8, 1);
  for (int i = 3; i >= 0; i--) items[at[i]] = {gaussian, slots[i]}, next[tiles[i]] = at[i] + 1;
}

// Fills the tiles with the Gaussians of a part; next[tile] is the position of the tile's next intersection.
inline void fill_tiles(View& view, const DepthOrder& order, int64_t part) {
  int32_t* next = view.histogram.data() + part * view.corners();
  Intersection* items = view.intersections.data();
  for_each_of_part(view, order, part, [&](uint32_t gaussian) {
    const Coverage& c = view.coverage(gaussian);
    int32_t slot = int32_t(view.slot_begin(gaussian));
    if (c.tiny()) return fill_four(view, int32_t(gaussian), c, slot, next, items);
    for_each_rectangle(view, gaussian, [&](TileSpan rows, TileSpan columns) {
      for (int y = rows.begin(); y < rows.end(); y++)
        for (int x = columns.begin(); x < columns.end(); x++) items[next[y * view.tiles_x + x]++] = {int32_t(gaussian), slot++};
    });
  });
}

// Assigns the Gaussians to the tiles; each part processes a contiguous range, which keeps the order.
inline void deal_to_tiles(View& view, const uint64_t* keys, int64_t visible, int threads) {
  const DepthOrder order = {keys, visible, int(std::min<int64_t>(threads, visible / SLICE + 1))};
  constexpr int AHEAD = PREFETCH + LANES;
  std::fill_n(view.intersections.reserve(view.intersection_count + AHEAD) + view.intersection_count, AHEAD, Intersection{});
  view.tile_begin.reserve(view.tiles() + 1);
  if (view.counted) {
    sum_corners(view, view.histogram.data());
  } else {
    view.histogram.reserve(size_t(order.parts) * view.corners());
    parallel_for(order.parts, threads, 1, [&](int64_t part) { count_tiles(view, order, part); });
  }
  scan_histogram(view, order.parts);
  parallel_for(order.parts, threads, 1, [&](int64_t part) { fill_tiles(view, order, part); });
}

// Stages 1 to 3 of one view.
inline void build_view(const ForwardCall& call, View& view, int index, int threads) {
  view.prepare(call.scene, index);
  view.counted = threads == 1;
  if (view.counted) std::fill_n(view.histogram.reserve(view.corners()), view.corners(), 0);
  view.camera = make_camera(call.scene, index);
  parallel_for(view.slices.size(), threads, 1, [&](int64_t i) { project_slice(call, view, i); });
  number_slots(view, call.keep);
  const int64_t visible = gather_keys(view);
  deal_to_tiles(view, sort_by_depth(view, visible), visible, threads);
}

// Stages 1 to 3 of all views: whole views in parallel when there are enough of them, else within each view.
inline void build_views(const ForwardCall& call, Views& views) {
  const int threads = call.settings.threads;
  const bool by_view = call.scene.views >= threads;
  while (views.size() < size_t(call.scene.views)) views.emplace_back();
  parallel_for(call.scene.views, by_view ? threads : 1, 1,
               [&](int64_t v) { build_view(call, views[v], int(v), by_view ? 1 : threads); });
}

}  // namespace splat
