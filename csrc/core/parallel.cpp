// A pool of helper threads. No call waits for a thread that has not begun.
//
// A call publishes a job: its work in chunks. Its own thread takes chunk after chunk, and helpers
// that are awake do so too. When no chunk is left, the call only waits for the chunks that helpers
// have begun. A helper that finds no work stays awake for a short time, because the next job of a
// network follows at once, and then it sleeps. A call wakes at most one helper, which wakes the
// next.
#include "parallel.h"

#include <pthread.h>
#if defined(__linux__)
#  include <linux/futex.h>
#  include <sys/syscall.h>
#  include <unistd.h>
#endif

#include <atomic>
#include <chrono>
#include <exception>
#include <new>
#include <system_error>
#include <thread>

namespace darswin {
namespace {

constexpr int64_t kChunks = 2;  // for each thread, so that one that comes late finds work
constexpr int64_t kMostHelpers = 1023;
constexpr int kJobs = 16;  // of several callers at once; further ones work alone
constexpr std::chrono::microseconds kAwake{50};

// A job belongs to the call that has `taken` it. Others may touch its fields only while `state`
// counts them as helpers. They join while there are free seats. A job without free seats is closed.
struct alignas(64) Job {
  std::atomic<bool> taken{false};
  std::atomic<uint64_t> state{0};  // free seats * kSeat + helpers at work
  int64_t count = 0, chunks = 0;
  RangeBody body = nullptr;
  void* context = nullptr;
  std::exception_ptr* failure = nullptr;
  std::atomic<bool> failed{false};
  alignas(64) std::atomic<int64_t> next{0};

  static constexpr uint64_t kSeat = uint64_t{1} << 32;

  bool join() {
    uint64_t old = state.load(std::memory_order_relaxed);
    while (old >= kSeat) {
      if (state.compare_exchange_weak(old, old - kSeat + 1, std::memory_order_acquire)) return true;
    }
    return false;
  }
  void leave() {
    close();
    state.fetch_sub(1, std::memory_order_release);
  }
  void close() { state.fetch_and(kSeat - 1, std::memory_order_relaxed); }

  void work() {
    const int64_t each = count / chunks, extra = count % chunks;
    for (;;) {
      const int64_t k = next.fetch_add(1, std::memory_order_relaxed);
      if (k >= chunks) return;
      const int64_t begin = k * each + std::min(k, extra);
      try {
        body(context, begin, begin + each + (k < extra ? 1 : 0));
      } catch (...) {
        if (!failed.exchange(true, std::memory_order_relaxed)) *failure = std::current_exception();
        next.store(chunks, std::memory_order_relaxed);
      }
    }
  }
};

// It has no destructor, because helpers use it until the process ends.
struct Pool {
  Job jobs[kJobs];
  alignas(64) std::atomic<uint32_t> epoch{0};  // counts published jobs
  alignas(64) std::atomic<int32_t> asleep{0};
  std::atomic<int64_t> helpers{0}, seats{0};  // threads that exist, and seats of all jobs
  std::atomic<bool> growing{false};
};
static_assert(std::is_trivially_destructible_v<Pool>);
constinit Pool pool;

thread_local int64_t limit = 0;  // 0: none

inline void pause() {
#if defined(__x86_64__)
  __builtin_ia32_pause();
#elif defined(__aarch64__)
  __asm__ volatile("isb");
#endif
}

#if defined(__linux__)
void futex(int operation, uint32_t value) {
  syscall(SYS_futex, reinterpret_cast<uint32_t*>(&pool.epoch), operation, value, nullptr, nullptr,
          0);
}
// Sleeps unless or until the epoch is no longer the one seen. It may also return without a reason.
void sleep(uint32_t seen) { futex(FUTEX_WAIT_PRIVATE, seen); }
void wake_one() { futex(FUTEX_WAKE_PRIVATE, 1); }
#else
void sleep(uint32_t seen) { pool.epoch.wait(seen); }
void wake_one() { pool.epoch.notify_one(); }
#endif

// Wakes a helper if fewer are awake than there are seats.
void wake_if_needed() {
  const int64_t asleep = pool.asleep;
  if (asleep > 0 && pool.helpers - asleep < pool.seats) wake_one();
}

bool help_any() {
  for (Job& job : pool.jobs) {
    if (!job.join()) continue;
    if (job.state.load(std::memory_order_relaxed) >= Job::kSeat) wake_if_needed();
    job.work();
    job.leave();
    return true;
  }
  return false;
}

void help() {
  using Clock = std::chrono::steady_clock;
  for (;;) {
    const uint32_t seen = pool.epoch.load();
    if (help_any()) continue;
    const auto end = Clock::now() + kAwake;
    while (pool.epoch.load(std::memory_order_relaxed) == seen) {
      for (int k = 0; k < 16; ++k) pause();
      if (Clock::now() < end) continue;
      pool.asleep.fetch_add(1);
      sleep(seen);
      pool.asleep.fetch_sub(1);
      break;
    }
  }
}

// Starts helpers until there are as many as seats. There are at most as many as this call asks for,
// or as cores if several calls run at once.
void grow(int64_t asked) {
  if (pool.growing.exchange(true, std::memory_order_acquire)) return;
  // A fork copies no helper, and other threads may have been in the middle of anything.
  [[maybe_unused]] static const int once =
      pthread_atfork(nullptr, nullptr, [] { new (&pool) Pool; });
  static const int64_t cores = std::thread::hardware_concurrency();
  const int64_t most = std::max(asked, cores - 1);
  try {
    while (pool.helpers < std::min<int64_t>(pool.seats, most)) {
      std::thread(help).detach();
      ++pool.helpers;
    }
  } catch (const std::system_error&) {
    // The system allows no more threads, and those that there are do the work.
  }
  pool.growing.store(false, std::memory_order_release);
}

}  // namespace

int64_t (*thread_setting)() = [] { return int64_t{1}; };

int64_t num_threads() { return limit > 0 ? limit : thread_setting(); }

ThreadLimit::ThreadLimit(int64_t threads) : before(limit) { limit = threads; }
ThreadLimit::~ThreadLimit() { limit = before; }

void run_ranges(int64_t count, int64_t threads, RangeBody body, void* context) {
  Job* job = pool.jobs;
  while (job->taken.exchange(true, std::memory_order_acquire)) {
    if (++job == pool.jobs + kJobs) return body(context, 0, count);
  }
  std::exception_ptr failure;
  const int64_t seats = std::min({threads, count, kMostHelpers + 1}) - 1;
  job->count = count, job->chunks = std::min(count, (seats + 1) * kChunks);
  job->body = body, job->context = context, job->failure = &failure;
  job->failed.store(false, std::memory_order_relaxed);
  job->next.store(0, std::memory_order_relaxed);
  if (pool.seats.fetch_add(seats) + seats > pool.helpers) grow(seats);
  job->state.store(seats * Job::kSeat, std::memory_order_release);
  pool.epoch.fetch_add(1);
  wake_if_needed();
  job->work();
  job->close();
  while (job->state.load(std::memory_order_acquire) > 0) pause();
  pool.seats.fetch_sub(seats);
  job->taken.store(false, std::memory_order_release);
  if (failure != nullptr) std::rethrow_exception(failure);
}

}  // namespace darswin
