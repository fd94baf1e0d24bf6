// Buffers that only grow, and pools of objects that own such buffers.
#pragma once

#include <atomic>
#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <memory>
#include <mutex>
#include <vector>

#if defined(_WIN32)
#if !defined(_GLIBCXX_HAS_GTHREADS)
#error "std::mutex is missing: use MinGW-w64 with POSIX threads (x86_64-w64-mingw32-g++-posix)"
#endif
#include <malloc.h>
#else
#include <pthread.h>
#endif
#if defined(__linux__)
#include <sys/mman.h>
#endif

namespace splat {

// The memory that a call needs and can't get; becomes its return value.
struct OutOfMemory {
  int64_t bytes;
};

// The memory of the machine or its container, which the caller of the library knows.
inline std::atomic<int64_t>& memory_of_machine() {
  static std::atomic<int64_t> bytes{int64_t(1) << 36};
  return bytes;
}

// Linux overcommits memory and later kills the process, so larger requests are refused here.
inline void check_memory(int64_t bytes) {
  if (bytes > memory_of_machine() / 4 * 3) throw OutOfMemory{bytes};
}

#if defined(_WIN32)
inline void* aligned(size_t alignment, size_t bytes) { return _aligned_malloc(bytes, alignment); }
inline void free_aligned(void* memory) { _aligned_free(memory); }
#else
inline void* aligned(size_t alignment, size_t bytes) {
  void* fresh = nullptr;
  return posix_memalign(&fresh, alignment, bytes) ? nullptr : fresh;
}
inline void free_aligned(void* memory) { std::free(memory); }
#endif

template <class T> class Buffer {
 public:
  Buffer() = default;
  Buffer(const Buffer&) = delete;
  Buffer& operator=(const Buffer&) = delete;
  ~Buffer() { free_aligned(data_); }

  // Room for `count` items; the old contents are lost when it grows.
  T* reserve(size_t count) {
    if (count > capacity_) grow(count + count / 4 + 64);
    return data_;
  }
  T* data() { return data_; }
  const T* data() const { return data_; }
  T& operator[](size_t i) { return data_[i]; }
  const T& operator[](size_t i) const { return data_[i]; }

 private:
  void grow(size_t count) {
    const size_t bytes = sizeof(T) * count, huge_page = size_t(1) << 21;
    free_aligned(data_);
    data_ = nullptr, capacity_ = 0;
    void* fresh = aligned(bytes >= huge_page ? huge_page : 64, bytes);
    if (!fresh) throw OutOfMemory{int64_t(bytes)};
#if defined(__linux__)
    if (bytes >= huge_page) madvise(fresh, bytes, MADV_HUGEPAGE);
#endif
    data_ = static_cast<T*>(fresh), capacity_ = count;
  }

  T* data_ = nullptr;
  size_t capacity_ = 0;
};

// The one T of this process. Never destroyed, since threads outlive main(). A forked child has none of its parent's threads,
// and a lock that one of them held would stay locked: it gets a T of its own.
template <class T> T& of_process() {
  static T* instance = [] {
#if !defined(_WIN32)
    pthread_atfork(nullptr, nullptr, [] { instance = new T; });
#endif
    return new T;
  }();
  return *instance;
}

// A pool of objects whose buffers have already grown; keeps at most two idle ones.
template <class T> class Pool {
 public:
  std::unique_ptr<T> take() {
    std::lock_guard<std::mutex> lock(mutex_);
    if (idle_.empty()) return std::make_unique<T>();
    std::unique_ptr<T> item = std::move(idle_.back());
    idle_.pop_back();
    return item;
  }
  void give(std::unique_ptr<T> item) {
    std::lock_guard<std::mutex> lock(mutex_);
    if (idle_.size() < 2) idle_.push_back(std::move(item));
  }

 private:
  std::mutex mutex_;
  std::vector<std::unique_ptr<T>> idle_;
};

}  // namespace splat
