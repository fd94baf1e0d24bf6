// Stage 4, forward: blend the splats of a tile front to back.
#pragma once

#include "output.h"
#include "tile.h"

namespace splat {

struct BlendScratch {
  Staged staged;
  alignas(64) float peaks[CHUNK * LANES];  // largest weight of each splat, per lane
  alignas(64) float transmittance[TILE_PIXELS];
};

// Blends the splats of `list` into a strip of `p`; false when all its pixels have stopped.
SPLAT_FN bool blend_strip(BlendScratch& scratch, Planes& p, const StripPixels& pixels, const uint16_t* list, int count,
                          const BlendLimits& limits) {
  const int at = pixels.first;
  Floats transmittance = load(scratch.transmittance + at), sum = load(p.alpha + at);
  Floats red = load(p.red + at), green = load(p.green + at), blue = load(p.blue + at), depth = load(p.depth + at);
  bool live = true;
  for (int i = 0; i < count && live;) {
    for (const int stop = std::min(i + CHECK_EVERY, count); i < stop; i++) {
      const LocalSplat& s = scratch.staged.splats[list[i]];
      float* peak = scratch.peaks + list[i] * LANES;
      Floats y1, y2;
      const Floats alpha = alpha_of(power_at(s, pixels, y1, y2), limits.log2_alpha_min, limits.alpha_max);
      const Floats weight = weight_of(alpha, transmittance, limits.stop);
      transmittance -= alpha * transmittance;
      sum += weight, red += weight * s.red, green += weight * s.green, blue += weight * s.blue, depth += weight * s.depth;
      store(peak, maximum(weight, load(peak)));
    }
    transmittance = select(transmittance >= limits.stop, transmittance, Floats{});  // avoids denormals
    live = any_at_least(transmittance, limits.stop);
  }
  store(scratch.transmittance + at, transmittance), store(p.alpha + at, sum);
  store(p.red + at, red), store(p.green + at, green), store(p.blue + at, blue), store(p.depth + at, depth);
  return live;
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
    const Intersection* intersections = view.intersections.data() + first + i;
    for (int l = 0; l < std::min(LANES, count - i); l++) raise_to(contribution + intersections[l].gaussian, rows[0][l]);
  }
}

// Blends all intersections of a tile into `planes`; stores in the view which blocks each of them overlaps.
inline void blend_list(const ForwardCall& call, View& view, const TileFrame& frame, Planes& planes) {
  const BlendLimits limits = limits_of(call.settings);
  uint64_t* masks = call.keep ? view.block_masks.data() : nullptr;
  BlendScratch scratch;
  LiveStrips live;
  start_transmittance(view, frame, scratch.transmittance);
  int first = frame.begin;
  for (; first < frame.end && live.any(); first += CHUNK) {
    const int count = std::min(CHUNK, frame.end - first);
    stage<true>(view, frame, first, count, masks, scratch.staged);
    std::memset(scratch.peaks, 0, sizeof(float) * LANES * count);
    for_each_live_strip(scratch.staged, live, [&](const StripPixels& pixels, const uint16_t* list, int length) {
      return blend_strip(scratch, planes, pixels, list, length, limits);
    });
    raise_contributions(view, first, count, scratch.peaks, call.out.contribution + view.index * call.scene.gaussians);
  }
  if (masks && first < frame.end) std::fill(masks + first, masks + frame.end, 0);
}

// One tile of one view into the pictures and, for a backward pass, into the view.
inline void blend_tile(const ForwardCall& call, View& view, int tile) {
  const TileFrame frame = frame_of(view, tile);
  const bool empty = frame.begin == frame.end;
  Planes local;
  Planes& planes = call.keep && !empty ? view.planes[tile] : local;
  std::memset(&planes, 0, sizeof planes);
  if (!empty) blend_list(call, view, frame, planes);
  write_tile(call, view.index, frame, planes);
}

}  // namespace splat
