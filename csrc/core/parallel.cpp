// A pool of helper threads. No call waits for a thread that has not begun.
//
// A call publishes a job, whose work is cut into chunks. The calling thread takes chunk after
// chunk, and so do helpers that are awake. When no chunk is left, the call only waits for chunks
// that helpers have begun. A helper without work stays awake for a while, because the next job of a
// network follows at once, and then it sleeps. A call wakes at most one helper, on
// another core, and only for enough work; this helper wakes the next one.
#include "parallel.h"

#include <pthread.h>
#if defined(__linux__)
#  include <linux/futex.h>
#  include <sched.h>
#  include <sys/syscall.h>
#  include <unistd.h>
#endif

#include <atomic>
#include <chrono>
#include <exception>
#include <new>
#include <system_error>
#include <thread>
#include <utility>

namespace darswin {
namespace {

using Clock = std::chrono::steady_clock;
using Microseconds = std::chrono::duration<double, std::micro>;

// Several chunks for each thread leave work for a helper that comes late. But chunks should not be
// short, because many kernels prepare something for each.
constexpr double kChunks = 4, kChunkTime = 200;  // at most; at least, in microseconds
constexpr int64_t kMostHelpers = 1023, kSlices = 64;
constexpr int kJobs = 16;  // of several callers at once; further calls work alone
constexpr double kWorthWaking = 100, kAwake = 150;  // microseconds of work, and without work

// The end of the first k of so many contiguous parts of [0, count).
int64_t share(int64_t count, int64_t parts, int64_t k) {
  return count / parts * k + std::min(count % parts, k);
}

// A job belongs to the call that has `taken` it. A helper may touch its fields only while `state`
// counts this helper. It joins while there are free seats; a job without free seats is closed.
struct alignas(64) Job {
  std::atomic<bool> taken{false};
  std::atomic<uint64_t> state{0};  // free seats * kSeat + helpers at work
  int64_t count = 0, chunks = 0;
  RangeBody body = nullptr;
  void* context = nullptr;
  std::exception_ptr* failure = nullptr;
  std::atomic<bool> failed{false};
  int64_t slices = 0;  // of the chunks, one for each thread
  struct alignas(64) Slice {
    std::atomic<int64_t> next{0};  // the first chunk that nobody has begun
  } slice[kSlices];

  static constexpr uint64_t kSeat = uint64_t{1} << 32;

  bool join() {
    uint64_t old = state.load(std::memory_order_relaxed);
    while (old >= kSeat) {
      if (state.compare_exchange_weak(old, old - kSeat + 1, std::memory_order_acquire)) return true;
    }
    return false;
  }
  bool has_seats() const { return state.load(std::memory_order_relaxed) >= kSeat; }
  void close() { state.fetch_and(kSeat - 1, std::memory_order_relaxed); }
  void leave() {
    close();
    state.fetch_sub(1, std::memory_order_release);
  }

  // Takes the chunks of one slice after the other, and begins with its own.
  void work(int64_t thread) {
    for (int64_t k = 0; k < slices; ++k) take((thread + k) % slices);
  }
  void take(int64_t s) {
    const int64_t last = share(chunks, slices, s + 1);
    for (int64_t k; (k = slice[s].next.fetch_add(1, std::memory_order_relaxed)) < last;) {
      if (failed.load(std::memory_order_relaxed)) return;
      try {
        body(context, share(count, chunks, k), share(count, chunks, k + 1));
      } catch (...) {
        if (!failed.exchange(true, std::memory_order_relaxed)) *failure = std::current_exception();
      }
    }
  }
};

struct Helper {
  std::atomic<uint32_t> asleep{0};  // 1 until this helper is taken, to be woken
  int thread = 0;                   // its number in the system
};

// Helpers use it until the process ends, so it has no destructor.
struct Pool {
  Job jobs[kJobs];
  alignas(64) std::atomic<uint32_t> epoch{0};  // counts published jobs
  alignas(64) std::atomic<int64_t> asleep{0};  // helpers, at least
  std::atomic<int64_t> helpers{0}, seats{0};   // threads, and seats of all jobs
  Helper helper[kMostHelpers];
  std::atomic<bool> growing{false};

  bool needs_helpers() const { return helpers - asleep < seats; }
};
static_assert(std::is_trivially_destructible_v<Pool>);
constinit Pool pool;

const int64_t cores = std::thread::hardware_concurrency();

// A fork copies no helper, and other threads may have been in the middle of anything.
[[maybe_unused]] const int at_fork = pthread_atfork(nullptr, nullptr, [] { new (&pool) Pool; });

thread_local int64_t limit = 0;  // 0: none
thread_local bool use_torch = false;

void pause() {
#if defined(__x86_64__)
  __builtin_ia32_pause();
#elif defined(__aarch64__)
  __asm__ volatile("isb");
#endif
}

#if defined(__linux__)
void futex(std::atomic<uint32_t>& word, int operation, uint32_t value) {
  static_assert(sizeof(word) == sizeof(uint32_t));
  syscall(SYS_futex, &word, operation | FUTEX_PRIVATE_FLAG, value, nullptr, nullptr, 0);
}
int this_thread() { return static_cast<int>(syscall(SYS_gettid)); }
// May also return without a reason.
void wait_while(std::atomic<uint32_t>& word, uint32_t value) { futex(word, FUTEX_WAIT, value); }
// Wakes a helper on another core than this one, and of those that this thread may use. Linux may
// choose this one although others are idle: in a virtual machine, a core that sleeps looks as if
// the host used it. The helper would interrupt this thread, or wait for milliseconds.
void wake(Helper& helper) {
  cpu_set_t all{};
  sched_getaffinity(0, sizeof(all), &all);
  cpu_set_t others = all;
  CPU_CLR(sched_getcpu(), &others);
  const bool limited = sched_setaffinity(helper.thread, sizeof(others), &others) == 0;
  futex(helper.asleep, FUTEX_WAKE, 1);
  if (limited) sched_setaffinity(helper.thread, sizeof(all), &all);
}
#else
int this_thread() { return 0; }
void wait_while(std::atomic<uint32_t>& word, uint32_t value) { word.wait(value); }
void wake(Helper& helper) { helper.asleep.notify_one(); }
#endif

bool take(Helper& helper) {
  if (helper.asleep == 0 || helper.asleep.exchange(0) == 0) return false;
  --pool.asleep;
  return true;
}

// Sleeps until somebody wakes this helper, or not at all if the epoch is no longer the one seen.
void sleep(Helper& helper, uint32_t seen) {
  ++pool.asleep;
  helper.asleep = 1;
  if (pool.epoch != seen && take(helper)) return;
  while (helper.asleep != 0) wait_while(helper.asleep, 1);
}

void wake_if_needed() {
  for (int64_t k = 0; k < pool.helpers && pool.needs_helpers(); ++k) {
    if (take(pool.helper[k])) return wake(pool.helper[k]);
  }
}

bool help_any(int64_t helper) {
  for (Job& job : pool.jobs) {
    if (!job.join()) continue;
    if (job.has_seats()) wake_if_needed();
    job.work(helper);
    job.leave();
    return true;
  }
  return false;
}

// Stays awake until a new job comes, for as long as Python needs to call the next operator of a
// frame, and returns whether one came.
bool is_job_soon(uint32_t seen) {
  const auto begin = Clock::now();
  while (pool.epoch.load(std::memory_order_relaxed) == seen) {
    if (Microseconds(Clock::now() - begin).count() > kAwake) return false;
    for (int k = 0; k < 16; ++k) pause();
  }
  return true;
}

void help(int64_t helper) {
  pool.helper[helper - 1].thread = this_thread();
  for (;;) {
    const uint32_t seen = pool.epoch;
    if (!help_any(helper) && !is_job_soon(seen)) sleep(pool.helper[helper - 1], seen);
  }
}

// Starts helpers until there are as many as seats. There are at most as many as this call asks for,
// or as cores if several calls run at once.
void grow(int64_t asked) {
  if (pool.growing.exchange(true, std::memory_order_acquire)) return;
  const int64_t most = std::max(asked, cores - 1);
  try {
    while (pool.helpers < std::min<int64_t>(pool.seats, most)) {
      std::thread(help, pool.helpers + 1).detach();
      ++pool.helpers;
    }
  } catch (const std::system_error&) {
    // The system allows no more threads, and those that there are do the work.
  }
  pool.growing.store(false, std::memory_order_release);
}

// To wake a helper takes this thread tens of microseconds, and the helper comes after up to 150. So
// it is only woken if helpers would have had work for half of the recent time.
bool is_worth_waking(double microseconds) {
  thread_local double work = 0;
  thread_local Clock::time_point before{};
  const auto now = Clock::now();
  work = std::max(work - Microseconds(now - before).count() / 2, 0.0) + microseconds;
  before = now;
  if (work < kWorthWaking) return false;
  work = 0;
  return true;
}

}  // namespace

int64_t (*thread_setting)() = [] { return int64_t{1}; };

int64_t num_threads() { return limit > 0 ? limit : thread_setting(); }

ThreadLimit::ThreadLimit(int64_t threads) : before(limit) { limit = threads; }
ThreadLimit::~ThreadLimit() { limit = before; }

void (*torch_ranges)(int64_t, int64_t, RangeBody, void*) = nullptr;

bool TorchThreads::set(bool use) { return std::exchange(use_torch, use); }

void run_ranges(int64_t count, Threads threads, RangeBody body, void* context) {
  if (use_torch && torch_ranges != nullptr) return torch_ranges(count, threads, body, context);
  Job* job = pool.jobs;
  while (job->taken.exchange(true, std::memory_order_acquire)) {
    if (++job == pool.jobs + kJobs) return body(context, 0, count);
  }
  std::exception_ptr failure;
  const int64_t team = std::min({threads.count, count, kMostHelpers + 1}), seats = team - 1;
  const double each = std::clamp(threads.microseconds / (team * kChunkTime), 1.0, kChunks);
  job->count = count, job->chunks = std::min(count, team * static_cast<int64_t>(each));
  job->body = body, job->context = context, job->failure = &failure;
  job->failed.store(false, std::memory_order_relaxed);
  job->slices = std::min({team, job->chunks, kSlices});
  for (int64_t s = 0; s < job->slices; ++s) {
    job->slice[s].next.store(share(job->chunks, job->slices, s), std::memory_order_relaxed);
  }
  pool.seats += seats;
  job->state.store(seats * Job::kSeat, std::memory_order_release);
  ++pool.epoch;
  if (pool.needs_helpers() && is_worth_waking(threads.microseconds)) {
    grow(seats);
    wake_if_needed();
  }
  job->work(0);
  job->close();
  constexpr int kPauses = 1000;
  for (int k = 0; job->state.load(std::memory_order_acquire) > 0; ++k) {
    k < kPauses ? pause() : std::this_thread::yield();
  }
  pool.seats -= seats;
  job->taken.store(false, std::memory_order_release);
  if (failure != nullptr) std::rethrow_exception(failure);
}

}  // namespace darswin
