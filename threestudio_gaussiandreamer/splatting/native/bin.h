// Stages 2 and 3: sort the visible Gaussians by depth, then deal them to the tiles in that order.
#pragma once

#include "parallel.h"
#include "project.h"

namespace splat {

// Stable sort by the upper 32 bits (least significant digit first), of which those below `lowest` and above `highest` are
// constant after subtraction. Returns whichever of the two arrays holds the result.
inline uint64_t* radix_sort(uint64_t* items, uint64_t* spare, int64_t count, uint32_t lowest, uint32_t highest) {
  constexpr int DIGIT = 11;
  int32_t begin[1 << DIGIT];
  for (int shift = 0; (uint64_t(highest - lowest) >> shift) != 0; shift += DIGIT) {
    const auto digit = [&](uint64_t item) { return (uint32_t(item >> 32) - lowest) >> shift & ((1 << DIGIT) - 1); };
    std::fill(begin, begin + (1 << DIGIT), 0);
    for (int64_t i = 0; i < count; i++) begin[digit(items[i])]++;
    for (int32_t d = 0, sum = 0; d < (1 << DIGIT); d++) {
      const int32_t here = begin[d];
      begin[d] = sum, sum += here;
    }
    for (int64_t i = 0; i < count; i++) spare[begin[digit(items[i])]++] = items[i];
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

// Calls visit(tile) for the tiles of a Gaussian, in the order of its slots.
template <class Visit> SPLAT_FN void for_each_tile(const View& view, uint32_t gaussian, Visit visit) {
  const Coverage& c = view.coverage[gaussian];
  const TileSpan* spans = view.slice_of(gaussian).spans.data() + c.span;
  for (int r = 0; r < c.rows; r++)
    for (int x = spans[r].begin, tile = (c.row + r) * view.tiles_x; x < spans[r].end; x++) visit(tile + x);
}

// Sets each slice's first slot and the number of entries.
inline void number_slots(View& view) {
  view.entry_count = 0;
  for (Slice& slice : view.slices) slice.first_slot = int32_t(view.entry_count), view.entry_count += slice.slots;
  check_memory(view.entry_count * int64_t(sizeof(Entry) + sizeof(uint64_t) + sizeof(float) * ROW));
  if (view.entry_count > INT32_MAX) throw OutOfMemory{view.entry_count * int64_t(sizeof(float) * ROW)};
}

// From the counts per (part, tile) to where each part writes its first entry of each tile.
inline void scan_histogram(View& view, int parts) {
  const int tiles = view.tiles();
  int32_t sum = 0;
  for (int tile = 0; tile < tiles; tile++) {
    view.tile_begin[tile] = sum;
    for (int part = 0; part < parts; part++) {
      int32_t& here = view.histogram[size_t(part) * tiles + tile];
      const int32_t count = here;
      here = sum, sum += count;
    }
  }
  view.tile_begin[tiles] = sum;
}

// Deals the Gaussians `order[0..visible)` to the tiles; each part takes an equal run of them, so the order survives.
inline void deal_to_tiles(View& view, const uint64_t* order, int64_t visible, int threads) {
  const int parts = int(std::min<int64_t>(threads, visible / SLICE + 1)), tiles = view.tiles();
  int32_t* histogram = view.histogram.reserve(size_t(parts) * tiles);
  Entry* entries = view.entries.reserve(view.entry_count);
  view.tile_begin.reserve(tiles + 1);
  parallel_for(parts, threads, [&](int64_t part) {
    int32_t* counts = histogram + part * tiles;
    std::fill(counts, counts + tiles, 0);
    for (int64_t i = visible * part / parts; i < visible * (part + 1) / parts; i++)
      for_each_tile(view, uint32_t(order[i]), [&](int tile) { counts[tile]++; });
  });
  scan_histogram(view, parts);
  parallel_for(parts, threads, [&](int64_t part) {
    int32_t* next = histogram + part * tiles;
    for (int64_t i = visible * part / parts; i < visible * (part + 1) / parts; i++) {
      const uint32_t gaussian = uint32_t(order[i]);
      int32_t slot = view.slice_of(gaussian).first_slot + view.coverage[gaussian].slot;
      for_each_tile(view, gaussian, [&](int tile) { entries[next[tile]++] = {int32_t(gaussian), slot++}; });
    }
  });
}

// Stages 1 to 3 of one view.
inline void build_view(const SplatScene& scene, const SplatSettings& settings, const SplatPictures& out, View& view, int index, int threads) {
  view.index = index;
  view.tiles_x = (scene.width + TILE - 1) / TILE, view.tiles_y = (scene.height + TILE - 1) / TILE;
  view.camera = make_camera(scene, index);
  view.slices.resize((scene.gaussians + SLICE - 1) / SLICE);
  const size_t padded = view.slices.size() * SLICE;
  view.splats.reserve(padded), view.coverage.reserve(padded), view.keys.reserve(padded), view.spare_keys.reserve(padded);
  parallel_for(view.slices.size(), threads, [&](int64_t i) { project_slice(scene, settings, out, view, i); });
  number_slots(view);
  const int64_t visible = gather_keys(view);
  deal_to_tiles(view, sort_by_depth(view, visible), visible, threads);
}

}  // namespace splat
