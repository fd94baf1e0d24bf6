// Batches of vectors, and 2^x.
#pragma once

#include "lanes.h"
#include "splat_math.h"

namespace splat {

// Several vectors whose operations alternate. Those of a single vector would wait for one another, and processors look ahead too
// little to fill the time.
constexpr int BATCH = 4;
struct Batch {
  Floats of[BATCH];
};
struct BatchMask {
  Ints of[BATCH];
};

// {item(0), item(1), ...}
template <class B, class Item, int... K> SPLAT_FN B each(Item item, std::integer_sequence<int, K...>) { return {{item(K)...}}; }
template <class B = Batch, class Item> SPLAT_FN B each(Item item) {
  return each<B>(item, std::make_integer_sequence<int, BATCH>());
}

SPLAT_FN Batch operator+(const Batch& a, const Batch& b) {
  return each([&](int k) { return a.of[k] + b.of[k]; });
}
SPLAT_FN Batch operator-(const Batch& a, const Batch& b) {
  return each([&](int k) { return a.of[k] - b.of[k]; });
}
SPLAT_FN Batch operator*(const Batch& a, const Batch& b) {
  return each([&](int k) { return a.of[k] * b.of[k]; });
}
SPLAT_FN Batch operator+(const Batch& a, float b) {
  return each([&](int k) { return a.of[k] + b; });
}
SPLAT_FN Batch operator*(float a, const Batch& b) {
  return each([&](int k) { return a * b.of[k]; });
}
SPLAT_FN BatchMask operator>=(const Batch& a, const Batch& b) {
  return each<BatchMask>([&](int k) { return a.of[k] >= b.of[k]; });
}
SPLAT_FN Batch select(const BatchMask& mask, const Batch& a, const Batch& b) {
  return each([&](int k) { return mask.of[k] ? a.of[k] : b.of[k]; });
}
SPLAT_FN Batch minimum(const Batch& a, const Batch& b) {
  return each([&](int k) { return minimum(a.of[k], b.of[k]); });
}

#if defined(__AVX512F__)
// 2^x, relative error 1.6e-7: a minimax polynomial of x - floor(x), scaled by 2^floor(x).
SPLAT_FN Batch exp2(const Batch& x) {
  const auto fraction = [](Floats v) { return (Floats)_mm512_reduce_ps((__m512)v, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC); };
  const Batch r = each([&](int k) { return fraction(x.of[k]); });
  Batch y = 0.0018775766948238015f * r + 0.00898933969438076f;
  y = y * r + 0.05582631751894951f;
  y = y * r + 0.24015361070632935f;
  y = y * r + 0.6931530833244324f;
  y = y * r + 0.9999999403953552f;
  return each([&](int k) { return (Floats)_mm512_scalef_ps((__m512)y.of[k], (__m512)x.of[k]); });
}
#else
// 2^x for -126 <= x < 128, relative error 3e-7; undefined below. Adding 1.5 * 2^23 rounds to an integer n, which is then both
// subtracted and, in the low bits, added to the exponent; a minimax polynomial approximates the rest in [-1/2, 1/2].
SPLAT_FN Batch exp2(const Batch& x) {
  const float rounder = 12582912.0f;
  const Batch rounded = x + rounder, r = x - (rounded + -rounder);
  Batch y = 0.001327647129073739f * r + 0.009675540961325169f;
  y = y * r + 0.05550713092088699f;
  y = y * r + 0.24022120237350464f;
  y = y * r + 0.6931469440460205f;
  y = y * r + 1.0f;
  using Bits = Vector<LANES>::Unsigned;
  return each([&](int k) { return (Floats)((Bits)y.of[k] + ((Bits)rounded.of[k] << 23)); });
}
#endif

}  // namespace splat
