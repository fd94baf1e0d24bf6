// Batches of vectors, and 2^x.
#pragma once

#include <algorithm>
#include <type_traits>

#include "lanes.h"
#include "splat_math.h"

namespace splat {

// Several vectors whose operations alternate. Those of a single vector would wait for one another, and processors look ahead too
// little to fill the time. The 32 registers of AVX-512 have room for long batches.
constexpr int BATCH = 4;
#if defined(__AVX512F__)
constexpr int LONG_BATCH = 8;
#else
constexpr int LONG_BATCH = BATCH;
#endif

template <int N> struct Batch {
  Floats of[N];
};
template <int N> struct BatchMask {
  Ints of[N];
};

// {item(0), item(1), ...}
template <class B, class Item, int... K> SPLAT_FN B each(Item item, std::integer_sequence<int, K...>) { return {{item(K)...}}; }
template <int N, class B = Batch<N>, class Item> SPLAT_FN B each(Item item) {
  return each<B>(item, std::make_integer_sequence<int, N>());
}

template <int N> SPLAT_FN Batch<N> operator+(const Batch<N>& a, const Batch<N>& b) {
  return each<N>([&](int k) { return a.of[k] + b.of[k]; });
}
template <int N> SPLAT_FN Batch<N> operator-(const Batch<N>& a, const Batch<N>& b) {
  return each<N>([&](int k) { return a.of[k] - b.of[k]; });
}
template <int N> SPLAT_FN Batch<N> operator*(const Batch<N>& a, const Batch<N>& b) {
  return each<N>([&](int k) { return a.of[k] * b.of[k]; });
}
template <int N> SPLAT_FN Batch<N> operator+(const Batch<N>& a, float b) {
  return each<N>([&](int k) { return a.of[k] + b; });
}
template <int N> SPLAT_FN Batch<N> operator*(float a, const Batch<N>& b) {
  return each<N>([&](int k) { return a * b.of[k]; });
}
template <int N> SPLAT_FN BatchMask<N> operator>=(const Batch<N>& a, const Batch<N>& b) {
  return each<N, BatchMask<N>>([&](int k) { return a.of[k] >= b.of[k]; });
}
template <int N> SPLAT_FN Batch<N> select(const BatchMask<N>& mask, const Batch<N>& a, const Batch<N>& b) {
  return each<N>([&](int k) { return mask.of[k] ? a.of[k] : b.of[k]; });
}
template <int N> SPLAT_FN Batch<N> minimum(const Batch<N>& a, const Batch<N>& b) {
  return each<N>([&](int k) { return minimum(a.of[k], b.of[k]); });
}

// Calls blend(batch, first) for batches of a list of `count` splats, `batch.value` from `first` on, until it returns false; returns
// how many of the splats that took. Lambdas must be always_inline, or GCC keeps what they capture in memory.
template <class Blend> SPLAT_FN int in_batches(int count, Blend blend) {
  int first = 0;
  bool more = true;
  if constexpr (LONG_BATCH > BATCH)
    for (; more && first + BATCH < count; first += LONG_BATCH) more = blend(std::integral_constant<int, LONG_BATCH>(), first);
  for (; more && first < count; first += BATCH) more = blend(std::integral_constant<int, BATCH>(), first);
  return std::min(first, count);
}

#if defined(__AVX512F__)
// 2^x, relative error 1.6e-7: a minimax polynomial of x - floor(x), scaled by 2^floor(x).
template <int N> SPLAT_FN Batch<N> exp2(const Batch<N>& x) {
  const auto fraction = [](Floats v) { return (Floats)_mm512_reduce_ps((__m512)v, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC); };
  const Batch<N> r = each<N>([&](int k) { return fraction(x.of[k]); });
  Batch<N> y = 0.0018775766948238015f * r + 0.00898933969438076f;
  y = y * r + 0.05582631751894951f;
  y = y * r + 0.24015361070632935f;
  y = y * r + 0.6931530833244324f;
  y = y * r + 0.9999999403953552f;
  return each<N>([&](int k) { return (Floats)_mm512_scalef_ps((__m512)y.of[k], (__m512)x.of[k]); });
}
#else
// 2^x for -126 <= x < 128, relative error 3e-7; undefined below. Adding 1.5 * 2^23 rounds to an integer n, which is then both
// subtracted and, in the low bits, added to the exponent; a minimax polynomial approximates the rest in [-1/2, 1/2].
template <int N> SPLAT_FN Batch<N> exp2(const Batch<N>& x) {
  const float rounder = 12582912.0f;
  const Batch<N> rounded = x + rounder, r = x - (rounded + -rounder);
  Batch<N> y = 0.001327647129073739f * r + 0.009675540961325169f;
  y = y * r + 0.05550713092088699f;
  y = y * r + 0.24022120237350464f;
  y = y * r + 0.6931469440460205f;
  y = y * r + 1.0f;
  using Bits = Vector<LANES>::Unsigned;
  return each<N>([&](int k) { return (Floats)((Bits)y.of[k] + ((Bits)rounded.of[k] << 23)); });
}
#endif

}  // namespace splat
