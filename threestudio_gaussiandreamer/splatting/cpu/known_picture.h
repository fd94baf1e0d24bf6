// The gradient of score distillation towards one known picture per render, in one pass over the pixels: no splatting, but the
// same vectors and threads. Every operation is rounded as in plain torch, so gradients have the same bits.
#pragma once

#include <algorithm>

#include "interleaved.h"
#include "parallel.h"
#include "scene.h"

namespace splat {

// Keeps the compiler from fusing the product x with an addition.
SPLAT_FN Floats rounded(Floats x) {
#if defined(__x86_64__)
  asm("" : "+x"(x));
#elif defined(__aarch64__)
  asm("" : "+w"(x));
#endif
  return x;
}

// Bytes as numbers in [0, 1], `count` <= LANES of them.
SPLAT_FN Floats load_bytes(const uint8_t* p, int count) {
  typedef uint8_t Bytes __attribute__((vector_size(LANES)));
  Bytes bytes = {};
  std::memcpy(&bytes, p, count == LANES ? LANES : count);
  return __builtin_convertvector(bytes, Floats) / 255.0f;
}

// weight * scale * (x - x1), the gradient of the latent, with x = 2 render - 1 and x1 = 2 ((1 - coverage) background + picture) - 1.
SPLAT_FN Floats latent_gradient(Floats render, Floats picture, Floats rest, float background, float scale, float weight) {
  const Floats target = rounded(rest * background) + picture;
  return weight * (scale * ((2.0f * render - 1.0f) - (2.0f * target - 1.0f)));
}

// The gradient of the render for one row of pixels; returns the sum of the squares of that of the latent.
inline double known_gradient_of_row(const SplatKnownPictures& in, int64_t item, const float* render, const uint8_t* picture,
                                    float* gradient) {
  const int64_t plane = in.height * in.width;
  const float *background = in.background + 3 * item, scale = in.scale[item], weight = in.weight[item];
  Floats squares = {};
  for (int64_t x = 0; x < in.width; x += LANES) {
    const int count = int(std::min<int64_t>(LANES, in.width - x));
    const auto bytes = [&](int channel) { return load_bytes(picture + channel * plane + x, count); };
    const Vec3<Floats> c = load_items<3>(render + 3 * x, count, load3<Floats>);
    const Floats rest = 1.0f - bytes(3);
    const Vec3<Floats> g = {latent_gradient(c.x, bytes(0), rest, background[0], scale, weight),
                            latent_gradient(c.y, bytes(1), rest, background[1], scale, weight),
                            latent_gradient(c.z, bytes(2), rest, background[2], scale, weight)};
    store_items<3>(gradient + 3 * x, count, [&](float* p) { store3(p, in.slope * g); });
    Floats here = dot(g, g);
    for (int l = count; l < LANES; l++) here[l] = 0.0f;
    squares += here;
  }
  double sum = 0;
  for (int l = 0; l < LANES; l++) sum += squares[l];
  return sum;
}

inline void known_gradients(const SplatKnownPictures& in, const SplatKnownGradient& out) {
  parallel_for(in.items * in.height, in.threads, 8, [&](int64_t i) {
    const int64_t item = i / in.height, row = i % in.height, at = 3 * i * in.width;
    const uint8_t* picture = in.pictures[item] + row * in.width;
    out.squares[i] = known_gradient_of_row(in, item, in.render + at, picture, out.gradient + at);
  });
}

}  // namespace splat
