// One parallel loop; results must not depend on which thread runs what.
#pragma once

#include <algorithm>
#include <cstdint>
#include <exception>

namespace splat {

// body(i) for 0 <= i < count on up to `threads` threads; the first exception is thrown again here.
template <class Body> void parallel_for(int64_t count, int threads, const Body& body) {
  threads = int(std::min<int64_t>(threads, count));
  if (threads <= 1) {
    for (int64_t i = 0; i < count; i++) body(i);
    return;
  }
  std::exception_ptr error;
#pragma omp parallel for schedule(dynamic) num_threads(threads)
  for (int64_t i = 0; i < count; i++) {
    try {
      body(i);
    } catch (...) {
#pragma omp critical
      if (!error) error = std::current_exception();
    }
  }
  if (error) std::rethrow_exception(error);
}

}  // namespace splat
