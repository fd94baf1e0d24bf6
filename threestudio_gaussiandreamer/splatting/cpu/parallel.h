// A parallel loop on a team of threads: the caller works too, and at the end waits only for helpers that are executing a
// task, not for those that the system hasn't woken yet. (An OpenMP barrier waits for every thread;
// when other programs, or torch's own threads, hold the cores, that costs milliseconds where the work takes microseconds.)
#pragma once

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <exception>
#include <mutex>
#include <system_error>
#include <thread>

#include "buffer.h"

namespace splat {

inline void relax() {
#if defined(__x86_64__)
  __builtin_ia32_pause();
#else
  std::this_thread::yield();
#endif
}

class Team {
 public:
  // body(i) for 0 <= i < count on up to `threads` threads, `grain` neighbours at a time; the first exception is thrown again
  // here. While the team is at work, other callers and nested loops run on their own thread.
  template <class Body> void run(int64_t count, int threads, int grain, const Body& body) {
    const int helpers = int(std::min<int64_t>(threads, (count + grain - 1) / grain)) - 1;
    std::unique_lock<std::mutex> busy(busy_, std::defer_lock);
    if (helpers < 1 || !busy.try_lock()) {
      for (int64_t i = 0; i < count; i++) body(i);
      return;
    }
    const auto call = [](const void* b, int64_t i) { (*static_cast<const Body*>(b))(i); };
    Job job = {call, &body, count, grain};
    open(job, helpers);
    work(job);
    close(job);
    if (job.error) std::rethrow_exception(job.error);
  }

 private:
  struct Job {
    void (*call)(const void* body, int64_t i);
    const void* body;
    int64_t count, grain;
    std::atomic<int64_t> next{0};
    std::atomic<int> helping{0};
    std::exception_ptr error = nullptr;
  };

  static constexpr int SPINS = 4000;  // tens of microseconds, the pause between two stages

  // If the system grants no more threads, the existing ones do the work.
  void hire(int helpers) try {
    for (; workers_ < helpers; workers_++) std::thread([this] { help(); }).detach();
  } catch (const std::system_error&) {
  }

  void open(Job& job, int helpers) {
    std::lock_guard<std::mutex> lock(mutex_);
    hire(helpers);
    job_ = &job;
    seats_ = helpers;
    for (int i = 0; i < std::min(helpers, sleeping_); i++) wake_.notify_one();
  }

  void close(Job& job) {
    std::unique_lock<std::mutex> lock(mutex_);
    job_ = nullptr, seats_ = 0;
    lock.unlock();
    for (int i = 0; i < SPINS && job.helping; i++) relax();
    lock.lock();
    done_.wait(lock, [&] { return job.helping == 0; });
  }

  void work(Job& job) {
    for (int64_t i; (i = job.next.fetch_add(job.grain)) < job.count;) {
      try {
        for (const int64_t end = std::min(i + job.grain, job.count); i < end; i++) job.call(job.body, i);
      } catch (...) {
        std::lock_guard<std::mutex> lock(mutex_);
        if (!job.error) job.error = std::current_exception();
        job.next = job.count;
      }
    }
  }

  void help() {
    for (;;) {
      for (int i = 0; i < SPINS && seats_ == 0; i++) relax();
      std::unique_lock<std::mutex> lock(mutex_);
      sleeping_++;
      wake_.wait(lock, [&] { return seats_ > 0; });
      sleeping_--, seats_--;
      Job& job = *job_;
      job.helping++;
      lock.unlock();
      work(job);
      lock.lock();
      if (--job.helping == 0) done_.notify_one();
    }
  }

  std::mutex busy_, mutex_;
  std::condition_variable wake_, done_;
  Job* job_ = nullptr;
  std::atomic<int> seats_{0};
  int workers_ = 0, sleeping_ = 0;
};

template <class Body> void parallel_for(int64_t count, int threads, int grain, const Body& body) {
  of_process<Team>().run(count, threads, grain, body);
}

}  // namespace splat
