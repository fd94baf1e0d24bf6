// Stage 4, forward: blend the splats of a tile front to back.
#pragma once

#include "output.h"
#include "tile.h"

namespace splat {

// The largest weight of a splat, per lane of a block.
struct alignas(64) PeakRow {
  float lanes[ROW];
};

struct BlendScratch {
  Staged staged;
  alignas(64) PeakRow peaks[CHUNK + 1];
  alignas(64) float transmittance[TILE_PIXELS];
  Planes planes;
};

// The sums over the splats that were blended into a block.
struct BlockSums {
  Floats transmittance, alpha, red, green, blue, depth;
};

// Blends the splats of a batch into a block.
template <int N>
SPLAT_FN void blend_batch(BlendScratch& scratch, const BlockPixels& pixels, const uint16_t* list, const BlendLimits& limits,
                          BlockSums& sums) {
  const BatchSplats splats = {scratch.staged, list};
  const Batch<N> alphas = alpha_of(power_at<N>(splats, pixels), limits.log2_alpha_min, limits.alpha_max);
  for (int k = 0; k < N; k++) {
    const LocalSplat& s = splats[k];
    const Floats alpha = alphas.of[k], weight = weight_of(alpha, sums.transmittance, limits.stop);
    float* peak = row_at(scratch.peaks, list[k]).lanes;
    sums.transmittance -= alpha * sums.transmittance, sums.alpha += weight;
    sums.red += weight * s.red, sums.green += weight * s.green, sums.blue += weight * s.blue;
    sums.depth += weight * s.depth;
    store(peak, maximum(weight, load(peak)));
  }
  sums.transmittance = select(sums.transmittance >= limits.stop, sums.transmittance, Floats{});  // avoids denormals
}

// Blends the splats of `list` into a block; returns after how many of them all its pixels have stopped, or 0.
SPLAT_FN int blend_block(BlendScratch& scratch, const BlockPixels& pixels, const uint16_t* list, int count,
                         const BlendLimits& limits) {
  Planes& p = scratch.planes;
  const int at = pixels.first;
  BlockSums sums = {load(scratch.transmittance + at), load(p.alpha + at), load(p.red + at),
                    load(p.green + at),               load(p.blue + at),  load(p.depth + at)};
  bool live = true;
  const int blended = in_batches(count, [&](auto batch, int i) __attribute__((always_inline)) {
    blend_batch<batch.value>(scratch, pixels, list + i, limits, sums);
    return live = any_at_least(sums.transmittance, limits.stop);
  });
  store(scratch.transmittance + at, sums.transmittance), store(p.alpha + at, sums.alpha);
  store(p.red + at, sums.red), store(p.green + at, sums.green), store(p.blue + at, sums.blue), store(p.depth + at, sums.depth);
  return live ? 0 : blended;
}

// The largest weight of each of `count` splats, to their slots.
inline void store_peaks(const Intersection* intersections, int count, const PeakRow* rows, float* peaks) {
  for (int i = 0; i < count; i += LANES) {
    Floats columns[LANES];
    for (int l = 0; l < LANES; l++) columns[l] = load(rows[i + l].lanes);
    transpose(columns);
    for (int l = 1; l < LANES; l++) columns[0] = maximum(columns[0], columns[l]);
    for (int l = 0; l < std::min(LANES, count - i); l++) peaks[intersections[i + l].slot] = columns[0][l];
  }
}

// Intersections behind the last chunk that contributes are in no list and have no weight.
inline void skip_rest(View& view, int tile, int first, int end, bool keep) {
  for (int i = first; i < end; i++) view.peaks[view.intersections[i].slot] = 0.0f;
  for (; keep && first < end; first += CHUNK) std::fill_n(view.lists_of(tile, first).lengths, BLOCKS, 0);
}

// Blends all intersections of a tile into the planes; the view keeps the lists of each block's splats.
inline void blend_tile_splats(const ForwardCall& call, View& view, int tile, const TileFrame& frame, BlendScratch& scratch) {
  const BlendLimits limits = limits_of(call.settings);
  LiveBlocks live = LiveBlocks().set();
  start_transmittance(view, frame, scratch.transmittance);
  int first = frame.begin;
  for (; first < frame.end && live.any(); first += CHUNK) {
    const int count = std::min(CHUNK, frame.end - first);
    stage(view, frame, first, count, true, scratch.staged);
    std::memset(scratch.peaks, 0, sizeof(PeakRow) * count);
    ChunkLists* lists = call.keep ? &view.lists_of(tile, first) : nullptr;
    if (lists && first > frame.begin)
      std::memcpy(lists->transmittance.reserve(TILE_PIXELS), scratch.transmittance, sizeof scratch.transmittance);
    for_each_live_block(scratch.staged, live, lists, [&](const BlockPixels& pixels, const uint16_t* list, int length) {
      return blend_block(scratch, pixels, list, length, limits);
    });
    store_peaks(view.intersections.data() + first, count, scratch.peaks, view.peaks.data());
  }
  skip_rest(view, tile, first, frame.end, call.keep);
}

// One tile of one view into the pictures and, for a backward pass, into the view.
inline void blend_tile(const ForwardCall& call, View& view, int tile) {
  const TileFrame frame = frame_of(view, tile);
  BlendScratch scratch;
  prefetch_tile<true>(pictures_of(call, view.index), frame, call.settings.downsample);
  std::memset(&scratch.planes, 0, sizeof scratch.planes);
  if (frame.begin < frame.end) blend_tile_splats(call, view, tile, frame, scratch);
  write_tile(call, view.index, frame, scratch.planes);
}

// The largest of the weights in a Gaussian's slots [begin, end). Whether there are one to four can't be predicted: for fewer than
// four, the last one is read again.
inline float largest_peak(const float* peaks, int64_t begin, int64_t end) {
  if (begin == end) return 0.0f;
  const int64_t last = end - 1;
  const auto at = [&](int64_t slot) { return peaks[std::min(slot, last)]; };
  float peak = std::max(std::max(at(begin), at(begin + 1)), std::max(at(begin + 2), at(begin + 3)));
  for (int64_t slot = begin + 4; slot < end; slot++) peak = std::max(peak, peaks[slot]);
  return peak;
}

// The contribution of the Gaussians of a slice: the largest weight in any tile.
inline void store_contributions(const ForwardCall& call, const View& view, int64_t slice) {
  float* contribution = call.out.contribution + view.index * call.scene.gaussians;
  const int64_t end = std::min<int64_t>(call.scene.gaussians, (slice + 1) * SLICE);
  for (int64_t gaussian = slice * SLICE; gaussian < end; gaussian++)
    contribution[gaussian] = largest_peak(view.peaks.data(), view.slot_begin(gaussian), view.slot_end(gaussian));
}

}  // namespace splat
