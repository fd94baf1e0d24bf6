// Runs CUDA source on the host: every thread of a block is a fibre, barriers and warp functions are synchronisation points.
//
// Blocks run one after the other. Between them a fibre runs alone, in an order that the test chooses: results that
// depend on it reveal a missing barrier. Stricter than a GPU: a fibre that waits for one that has ended, or that reaches another
// kind of function, stops the launch with a message.
#pragma once

#include <setjmp.h>
#include <ucontext.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <functional>
#include <string>
#include <vector>

#define __global__
#define __device__
#define __noinline__ __attribute__((noinline))
#define __forceinline__ inline
#define __launch_bounds__(...)
// In a section of its own, so that the values of an earlier block can be overwritten.
#define __shared__ static __attribute__((section("cuda_shared")))
extern "C" char __start_cuda_shared[], __stop_cuda_shared[];

struct Index3 {
  unsigned x, y, z;
};
inline Index3 threadIdx, blockIdx, blockDim, gridDim;

namespace shim {

constexpr unsigned WARP = 32;
constexpr size_t STACK = 128 * 1024;

enum Order { FORWARD, BACKWARD, SHUFFLED };
enum Kind { NOTHING, BARRIER_OR, BALLOT, SHUFFLE, SYNC_WARP };
inline const char* const NAMES[] = {"nothing", "__syncthreads_or", "__ballot_sync", "__shfl_xor_sync", "__syncwarp"};

struct Fibre {
  ucontext_t context;
  jmp_buf at;
  bool started, done;
  Kind waits_for;
  unsigned given;      // its contribution to the synchronisation
  unsigned received;   // the value that it receives
};

struct Block {
  std::vector<Fibre> fibres;
  std::vector<char> stacks;
  ucontext_t scheduler_context;
  jmp_buf scheduler;
  unsigned current;
  std::function<void()> kernel;
  std::string error;
};
inline Block block;

inline void enter() {
  block.kernel();
  block.fibres[block.current].done = true;
  _longjmp(block.scheduler, 1);
}

// Runs a fibre until it waits or ends. The first time through a context of its own, later by a jump, which costs no system call.
inline void resume(unsigned i) {
  Fibre& fibre = block.fibres[i];
  block.current = i, threadIdx = {i, 0, 0};
  if (_setjmp(block.scheduler)) return;
  if (fibre.started) _longjmp(fibre.at, 1);
  fibre.started = true;
  getcontext(&fibre.context);
  fibre.context.uc_stack.ss_sp = &block.stacks[STACK * i], fibre.context.uc_stack.ss_size = STACK;
  makecontext(&fibre.context, enter, 0);
  swapcontext(&block.scheduler_context, &fibre.context);
}

// Waits until all of the warp, or of the block, are here; returns the value for this thread.
inline unsigned meet(Kind kind, unsigned given) {
  Fibre& fibre = block.fibres[block.current];
  fibre.waits_for = kind, fibre.given = given;
  if (!_setjmp(fibre.at)) _longjmp(block.scheduler, 1);
  return fibre.received;
}

// The values that fibres [begin, end) receive when all have arrived; for a shuffle, their contributions.
inline void give(Kind kind, unsigned begin, unsigned end) {
  unsigned all = 0;
  for (unsigned i = begin; i < end; i++) {
    if (kind == BARRIER_OR) all |= block.fibres[i].given;
    if (kind == BALLOT) all |= unsigned(block.fibres[i].given != 0) << (i - begin);
  }
  for (unsigned i = begin; i < end; i++) {
    Fibre& fibre = block.fibres[i];
    fibre.received = kind == SHUFFLE ? fibre.given : all, fibre.waits_for = NOTHING;
  }
}

inline bool waits_for_block(const Fibre& fibre) { return fibre.waits_for == BARRIER_OR; }

inline void fail(unsigned begin, const char* why, const Fibre& a, const Fibre& b) {
  const std::string place = "block (" + std::to_string(blockIdx.x) + ", " + std::to_string(blockIdx.y) + "), threads from ";
  const auto state = [](const Fibre& fibre) { return std::string(fibre.done ? "ended" : NAMES[fibre.waits_for]); };
  block.error = std::string(why) + " in " + place + std::to_string(begin) + ": " + state(a) + " and " + state(b);
}

// Resumes the fibres [begin, end) if all have arrived; false if none is waiting.
inline bool settle(unsigned begin, unsigned end) {
  const Fibre& first = block.fibres[begin];
  for (unsigned i = begin; i < end; i++) {
    const Fibre& fibre = block.fibres[i];
    if (fibre.done != first.done || fibre.waits_for != first.waits_for) return fail(begin, "threads that don't meet", first, fibre), false;
  }
  if (first.done || waits_for_block(first)) return true;
  give(first.waits_for, begin, end);
  return true;
}

inline std::vector<unsigned> order_of(unsigned count, Order order, unsigned seed) {
  std::vector<unsigned> items(count);
  for (unsigned i = 0; i < count; i++) items[i] = order == BACKWARD ? count - 1 - i : i;
  for (unsigned i = count; order == SHUFFLED && i > 1; i--) {
    seed = seed * 1664525u + 1013904223u;
    std::swap(items[i - 1], items[(seed >> 8) % i]);
  }
  return items;
}

inline bool ended(const Fibre& fibre) { return fibre.done; }
inline bool at_barrier(const Fibre& fibre) { return !fibre.done && waits_for_block(fibre); }

// Runs a warp until it needs the others: to a barrier of the block, or to its end.
inline bool run_warp(unsigned begin, unsigned end, Order order, unsigned round) {
  const auto stuck = [](const Fibre& fibre) { return ended(fibre) || at_barrier(fibre); };
  while (!std::all_of(&block.fibres[begin], &block.fibres[begin] + (end - begin), stuck)) {
    for (unsigned i : order_of(end - begin, order, round++))
      if (!stuck(block.fibres[begin + i])) resume(begin + i);
    if (!settle(begin, end)) return false;
  }
  return true;
}

// Warps run one after the other from barrier to barrier, which exposes missing barriers best.
inline bool run_block(Order order) {
  const unsigned threads = unsigned(block.fibres.size());
  std::memset(__start_cuda_shared, 0xff, __stop_cuda_shared - __start_cuda_shared);  // NaN; a GPU leaves it undefined
  for (Fibre& fibre : block.fibres) fibre.started = fibre.done = false, fibre.waits_for = NOTHING;
  for (unsigned round = 7 * blockIdx.x;; round++) {
    for (unsigned warp : order_of((threads + WARP - 1) / WARP, order, round))
      if (!run_warp(WARP * warp, std::min(threads, WARP * (warp + 1)), order, round)) return false;
    if (std::all_of(block.fibres.begin(), block.fibres.end(), ended)) return true;
    if (!std::all_of(block.fibres.begin(), block.fibres.end(), at_barrier))
      return fail(0, "a barrier that some never reach", block.fibres[0], block.fibres[threads - 1]), false;
    give(BARRIER_OR, 0, threads);
  }
}

inline bool run_grid(Index3 grid, unsigned threads, Order order, std::function<void()> kernel) {
  block.fibres.resize(threads), block.stacks.resize(STACK * threads);
  block.kernel = std::move(kernel), block.error.clear();
  gridDim = grid, blockDim = {threads, 1, 1};
  for (blockIdx.y = 0; blockIdx.y < grid.y; blockIdx.y++)
    for (blockIdx.x = 0; blockIdx.x < grid.x; blockIdx.x++)
      if (!run_block(order)) return false;
  return true;
}

// Calls a kernel with arguments as cuLaunchKernel takes them: one pointer to each.
template <class... A, size_t... I> void call(void (*kernel)(A...), void** arguments, std::index_sequence<I...>) {
  kernel(*static_cast<A*>(arguments[I])...);
}
template <class... A> std::function<void()> bind(void (*kernel)(A...), void** arguments) {
  return [=] { call(kernel, arguments, std::index_sequence_for<A...>{}); };
}

template <class To, class From> To bits(From x) {
  To y;
  static_assert(sizeof x == sizeof y, "");
  std::memcpy(&y, &x, sizeof x);
  return y;
}

}  // namespace shim

inline int __syncthreads_or(int p) { return shim::meet(shim::BARRIER_OR, p != 0); }
inline void __syncthreads() { shim::meet(shim::BARRIER_OR, 0); }
inline unsigned __ballot_sync(unsigned, int p) { return shim::meet(shim::BALLOT, p != 0); }
inline int __any_sync(unsigned, int p) { return __ballot_sync(~0u, p) != 0; }
inline void __syncwarp() { shim::meet(shim::SYNC_WARP, 0); }
template <class T> T __shfl_xor_sync(unsigned, T value, int mask) {
  shim::meet(shim::SHUFFLE, shim::bits<unsigned>(value));
  return shim::bits<T>(shim::block.fibres[threadIdx.x ^ mask].received);
}
inline unsigned atomicMax(unsigned* p, unsigned value) {
  const unsigned old = *p;
  *p = std::max(old, value);
  return old;
}
inline float __fmaf_rn(float a, float b, float c) { return std::fma(a, b, c); }
inline int __ffs(unsigned x) { return __builtin_ffs(int(x)); }
inline int __float_as_int(float x) { return shim::bits<int>(x); }
inline unsigned __float_as_uint(float x) { return shim::bits<unsigned>(x); }
