// Data shared by the stages of one call.
#pragma once

#include <cmath>

#include "view.h"

namespace splat {

struct ForwardCall {
  const Scene& scene;
  const SplatSettings& settings;
  const SplatPictures& out;
  bool keep;  // whether to keep what a backward pass needs
};

// Buffers of a backward pass.
struct Workspace {
  Buffer<float> slots;     // (intersections of all views, ROW): gradient sums of a splat in a tile
  Buffer<float> viewmats;  // (slices of Gaussians, views, 16)
};

struct BackwardCall {
  const Scene& scene;
  const SplatSettings& settings;
  const SplatUpstream& upstream;
  const SplatGradients& out;
  Views& views;
  std::vector<int64_t> first_slots;  // of each view
  Workspace& work;

  float* slots(const View& view) const { return work.slots.data() + first_slots[view.index] * ROW; }
};

struct BlendLimits {
  float log2_alpha_min, alpha_max, stop;
};

inline BlendLimits limits_of(const SplatSettings& s) { return {std::log2(s.alpha_min), s.alpha_max, s.stop}; }

// LANES Gaussians from `first` on, of which `count` exist.
struct Group {
  int64_t first;
  int count;
};

// Calls visit(group) for the Gaussians [begin, end).
template <class Visit> void for_each_group(int64_t begin, int64_t end, const Visit& visit) {
  for (int64_t first = begin; first < end; first += LANES) visit(Group{first, int(std::min<int64_t>(LANES, end - first))});
}

}  // namespace splat
