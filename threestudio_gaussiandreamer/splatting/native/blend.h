// Stage 4, forward: blend the splats of a tile front to back.
#pragma once

#include "output.h"
#include "tile.h"

namespace splat {

struct BlendScratch {
  alignas(64) LocalSplat splats[CHUNK];
  alignas(64) float peaks[CHUNK * LANES];  // largest weight of each splat, per lane
  alignas(64) float transmittance[TILE_PIXELS];
  BlockLists lists;
  Planes planes;
};

// Blends the splats of `list` into a strip; false when all its pixels have stopped.
SPLAT_FN bool blend_strip(BlendScratch& scratch, const StripPixels& pixels, const uint16_t* list, int count, const BlendLimits& limits) {
  const int at = pixels.first;
  Planes& p = scratch.planes;
  Floats transmittance = load(scratch.transmittance + at), end = load(p.transmittance + at);
  Floats red = load(p.red + at), green = load(p.green + at), blue = load(p.blue + at), depth = load(p.depth + at);
  for (int i = 0; i < count;) {
    for (const int stop = std::min(i + CHECK_EVERY, count); i < stop; i++) {
      const LocalSplat& s = scratch.splats[list[i]];
      float* peak = scratch.peaks + list[i] * LANES;
      Floats y1, y2;
      const Floats alpha = alpha_of(power_at(s, pixels, y1, y2), limits.log2_alpha_min, limits.alpha_max);
      const Floats weight = weight_of(alpha, transmittance, limits.stop), next = transmittance - alpha * transmittance;
      end = select(transmittance >= limits.stop, next, end);
      transmittance = next;
      red += weight * s.red, green += weight * s.green, blue += weight * s.blue, depth += weight * s.depth;
      store(peak, maximum(weight, load(peak)));
    }
    transmittance = select(transmittance >= limits.stop, transmittance, Floats{});  // keeps it out of the denormals
    if (!any_at_least(transmittance, limits.stop)) break;
  }
  store(scratch.transmittance + at, transmittance), store(p.transmittance + at, end);
  store(p.red + at, red), store(p.green + at, green), store(p.blue + at, blue), store(p.depth + at, depth);
  return any_at_least(transmittance, limits.stop);
}

// A maximum is exact, so the order of the tiles doesn't matter; positive floats compare like their bits.
inline void raise_to(float* target, float value) {
  uint32_t bits, *word = reinterpret_cast<uint32_t*>(target);
  std::memcpy(&bits, &value, sizeof bits);
  uint32_t old = __atomic_load_n(word, __ATOMIC_RELAXED);
  while (old < bits && !__atomic_compare_exchange_n(word, &old, bits, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED)) {
  }
}

inline void raise_contributions(const View& view, int first, int count, const float* peaks, float* contribution) {
  for (int i = 0; i < count; i += LANES) {
    Floats rows[LANES];
    for (int l = 0; l < LANES; l++) rows[l] = load(peaks + (i + l) * LANES);
    transpose(rows);
    for (int l = 1; l < LANES; l++) rows[0] = maximum(rows[0], rows[l]);
    for (int l = 0; l < std::min(LANES, count - i); l++) raise_to(contribution + view.entries[first + i + l].gaussian, rows[0][l]);
  }
}

// Blends one chunk of the tile's entries; returns how many strips are left, out of `live`.
inline int blend_chunk(BlendScratch& scratch, int count, uint64_t* live, const BlendLimits& limits) {
  int left = 0;
  std::memset(scratch.peaks, 0, sizeof(float) * LANES * count);
  for (int block = 0; block < BLOCKS; block++)
    for (int strip = 0; strip < STRIPS; strip++) {
      if (!(live[strip] >> block & 1)) continue;
      if (blend_strip(scratch, strip_pixels(block, strip), scratch.lists.splats[block], scratch.lists.lengths[block], limits))
        left++;
      else
        live[strip] &= ~(uint64_t(1) << block);
    }
  return left;
}

inline void clear(Planes& planes) {
  std::memset(&planes, 0, sizeof planes);
  std::fill(planes.transmittance, planes.transmittance + TILE_PIXELS, 1.0f);
}

// One tile of one view into the pictures, and into the view what a backward pass needs.
inline void blend_tile(View& view, int tile, const BlendLimits& limits, const OutputPlan& plan, bool keep, float* contribution) {
  const TileFrame frame = frame_of(view, tile);
  BlendScratch scratch;
  clear(scratch.planes);
  start_transmittance(view, frame, scratch.transmittance);
  uint64_t live[STRIPS];
  std::fill(live, live + STRIPS, ~uint64_t(0));
  for (int first = frame.begin, left = 1; first < frame.end && left; first += CHUNK) {
    const int count = std::min(CHUNK, frame.end - first);
    stage(view, frame, first, count, scratch.splats, scratch.lists, [&](int entry, const Splat& splat) {
      const uint64_t mask = block_mask(splat, float(frame.left), float(frame.top));
      if (keep) view.block_masks[entry] = mask;
      return mask;
    });
    left = blend_chunk(scratch, count, live, limits);
    raise_contributions(view, first, count, scratch.peaks, contribution);
  }
  write_tile(plan, frame, scratch.planes);
  if (keep && frame.end > frame.begin) view.planes[tile] = scratch.planes;
}

}  // namespace splat
