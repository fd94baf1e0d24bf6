// The AVX-512 intrinsics that the CPU kernel calls, by scalar code: its build of 16 lanes then runs on any processor with AVX2.
// Include it before the kernel's source.
#pragma once

#include <immintrin.h>

#include <cmath>
#include <cstdint>
#include <cstring>

#define __AVX512F__ 1  // after immintrin.h, whose own declarations depend on it

namespace emulated {

typedef float Floats __attribute__((vector_size(64), may_alias));
typedef int32_t Ints __attribute__((vector_size(64), may_alias));
constexpr int LANES = 16;

#define EMULATED static inline __attribute__((always_inline))

template <class Test> EMULATED __mmask16 mask_of(Test test) {
  int mask = 0;
  for (int l = 0; l < LANES; l++) mask |= int(test(l)) << l;
  return __mmask16(mask);
}

EMULATED void stream(float* to, Floats v) {
  if (reinterpret_cast<uintptr_t>(to) % sizeof v) __builtin_trap();
  for (int l = 0; l < LANES; l++) to[l] = v[l];
}
EMULATED Floats set1(float x) { return Floats{} + x; }
EMULATED Ints set1(int x) { return Ints{} + x; }

// The second operand where either is NaN, as minps and maxps.
EMULATED Floats minimum(Floats a, Floats b) { return a < b ? a : b; }
EMULATED Floats maximum(Floats a, Floats b) { return a > b ? a : b; }

EMULATED __mmask16 at_least(Floats a, Floats b) {
  return mask_of([=](int l) { return a[l] >= b[l]; });
}
EMULATED __mmask16 test(Ints a, Ints b) {
  return mask_of([=](int l) { return (a[l] & b[l]) != 0; });
}

EMULATED Ints compress(__mmask16 mask, Ints x) {
  Ints front = {};
  for (int l = 0, count = 0; l < LANES; l++)
    if (mask >> l & 1) front[count++] = x[l];
  return front;
}

EMULATED __m256i to_halves(Ints x) {
  uint16_t halves[LANES];
  for (int l = 0; l < LANES; l++) halves[l] = uint16_t(x[l]);
  __m256i v;
  std::memcpy(&v, halves, sizeof v);
  return v;
}

EMULATED Floats insert(Floats v, __m128 quad, int group) {
  float four[4];
  std::memcpy(four, &quad, sizeof four);
  for (int i = 0; i < 4; i++) v[4 * group + i] = four[i];
  return v;
}

// x - floor(x), rounded to nearest, where the instruction rounds down; of infinity, 0.
EMULATED Floats fraction(Floats x) {
  for (int l = 0; l < LANES; l++) x[l] = std::isinf(x[l]) ? 0.0f : x[l] - std::floor(x[l]);
  return x;
}

// a 2^floor(b).
EMULATED Floats scale(Floats a, Floats b) {
  for (int l = 0; l < LANES; l++) a[l] = std::ldexp(a[l], int(std::fmin(std::fmax(std::floor(b[l]), -1e3f), 1e3f)));
  return a;
}

}  // namespace emulated

// known_picture.h asks for a register of 64 bytes to keep a product from being fused with a sum: this build fuses none.
#define asm(...)

#define _mm512_stream_ps(to, v) emulated::stream(to, (emulated::Floats)(v))
#define _mm512_set1_ps(x) emulated::set1(float(x))
#define _mm512_set1_epi32(x) emulated::set1(int(x))
#define _mm512_maskz_min_ps(all, a, b) emulated::minimum((emulated::Floats)(a), (emulated::Floats)(b))
#define _mm512_maskz_max_ps(all, a, b) emulated::maximum((emulated::Floats)(a), (emulated::Floats)(b))
#define _mm512_cmp_ps_mask(a, b, how) emulated::at_least((emulated::Floats)(a), b)
#define _mm512_test_epi32_mask(a, b) emulated::test((emulated::Ints)(a), b)
#define _mm512_maskz_compress_epi32(mask, x) emulated::compress(mask, (emulated::Ints)(x))
#define _mm512_cvtepi32_epi16(x) emulated::to_halves((emulated::Ints)(x))
#define _mm512_castps128_ps512(quad) ((__m512)emulated::insert(emulated::Floats{}, quad, 0))
#define _mm512_insertf32x4(v, quad, group) ((__m512)emulated::insert((emulated::Floats)(v), quad, group))
#define _mm512_reduce_ps(x, how) emulated::fraction((emulated::Floats)(x))
#define _mm512_scalef_ps(a, b) emulated::scale((emulated::Floats)(a), (emulated::Floats)(b))
