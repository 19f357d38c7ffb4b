// Threads over contiguous ranges, and working memory for each thread. With these, every driver is
// fast and still gives the same bits for any number of threads.
#pragma once

#if defined(__linux__)
#  include <sys/mman.h>
#endif

#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <limits>
#include <memory>
#include <new>
#include <type_traits>
#include <utility>

namespace darswin {

// Asks the system for large pages. Mapping new memory page by page takes longer than writing it,
// and large pages make the mapping faster. Below 32 MB, glibc hands out memory that it has kept and
// that is already mapped.
inline void ask_for_large_pages(void* memory, size_t bytes) {
#if defined(__linux__) && defined(MADV_HUGEPAGE)
  constexpr uintptr_t kPage = 4096, kLeast = uintptr_t{32} << 20;
  if (bytes < kLeast) return;
  const auto begin = reinterpret_cast<uintptr_t>(memory);
  const uintptr_t first = (begin + kPage - 1) / kPage * kPage;
  madvise(reinterpret_cast<void*>(first), (begin + bytes - first) / kPage * kPage, MADV_HUGEPAGE);
#else
  (void)memory, (void)bytes;
#endif
}

// Working memory of the calling thread, for the lifetime of this object. It has at least `bytes`
// bytes, is aligned to cache lines and is not initialized. Up to kKept bytes stay with the thread
// between uses, because fresh pages cost more than the work of the kernels in them. So a thread can
// have only one of these objects of each kind at a time. Throws std::bad_alloc.
template <int kKind>
class ThreadMemoryOf {
 public:
  explicit ThreadMemoryOf(size_t bytes) {
    if (bytes <= size) return;
    free();
    if (bytes > PTRDIFF_MAX) throw std::bad_alloc();
    memory.reset(std::aligned_alloc(64, (bytes + kUnit - 1) / kUnit * kUnit));
    if (memory == nullptr) throw std::bad_alloc();
    ask_for_large_pages(memory.get(), bytes);
    size = bytes;
#if defined(__SANITIZE_ADDRESS__)  // numbers that nobody wrote are NaN, so that tests find them
    std::memset(memory.get(), 0xFF, bytes);
#endif
  }
  ~ThreadMemoryOf() {
    if (size > kKept) free();
  }
  ThreadMemoryOf(const ThreadMemoryOf&) = delete;

  void* get() const { return memory.get(); }

 private:
#if defined(__SANITIZE_ADDRESS__)  // so that it sees every access beyond the end
  static constexpr size_t kKept = 0, kUnit = 64;
#else
  static constexpr size_t kKept = size_t{32} << 20, kUnit = 4096;
#endif

  struct Free {
    void operator()(void* memory) const { std::free(memory); }
  };
  static void free() {
    memory.reset();
    size = 0;
  }

  static inline thread_local std::unique_ptr<void, Free> memory;
  static inline thread_local size_t size = 0;
};
using ThreadMemory = ThreadMemoryOf<0>;

// The number of threads that the caller allows: that of the innermost ThreadLimit of this thread,
// else that of `thread_setting`.
int64_t num_threads();

// Says how many threads a call may use without a ThreadLimit. In libdarswin.so this is torch's
// setting; without torch it is one thread.
extern int64_t (*thread_setting)();

// Sets the number of threads that calls of this thread may use, for the lifetime of this object.
class ThreadLimit {
 public:
  explicit ThreadLimit(int64_t threads);
  ~ThreadLimit();
  ThreadLimit(const ThreadLimit&) = delete;

 private:
  int64_t before;
};

// The number of threads of a call, and about how long one thread alone would take.
struct Threads {
  int64_t count;
  double microseconds = std::numeric_limits<double>::max();

  operator int64_t() const { return count; }
};

// Returns the number of threads that is worth using for so many microseconds of work. A helper that
// is awake takes about a microsecond to begin. parallel.cpp decides whether to wake one.
inline Threads threads_for(double microseconds) {
  constexpr double kLeast = 10;  // microseconds for each thread
  const double most = std::max(microseconds / kLeast, 1.0);
  const int64_t threads = num_threads();
  return {most < static_cast<double>(threads) ? static_cast<int64_t>(most) : threads, microseconds};
}

// Returns an estimate of the microseconds that it takes to sample so many points or pixels. On a
// Zen 4, two threads are 5 % slower than one for 512 points with 3 channels, and 10 to 16 % faster
// for 2048. For 1024 pixels with 8 channels they are 18 % slower, and 16 % faster for 4096.
inline double sampling_microseconds(double count, int64_t channels) {
  constexpr double kPerMicrosecond = 700;
  return count * static_cast<double>(channels + 4) / kPerMicrosecond;
}

using RangeBody = void (*)(void* context, int64_t begin, int64_t end);

// Calls of this thread use the threads of torch, for the lifetime of this object. In training,
// torch's own operators come before and after ours. Their helper threads stay awake for some
// milliseconds, and two teams that are awake would compete for the cores.
class TorchThreads {
 public:
  TorchThreads() : before(set(true)) {}
  ~TorchThreads() { set(before); }
  TorchThreads(const TorchThreads&) = delete;

  static bool set(bool use);  // returns what was set before

 private:
  bool before;
};

// Runs ranges on the threads of torch. libdarswin.so sets it; null without torch.
extern void (*torch_ranges)(int64_t count, int64_t threads, RangeBody body, void* context);

// Calls body(context, begin, end) as parallel_ranges does.
void run_ranges(int64_t count, Threads threads, RangeBody body, void* context);

// Calls body(begin, end) on contiguous ranges that cover [0, count), in up to so many threads. A
// thread may take several ranges. The first exception of a range is thrown again when all ranges
// that began have ended; further ones need not begin.
template <typename Body>
void parallel_ranges(int64_t count, Threads threads, Body&& body) {
  if (count <= 0) return;
  if (count == 1 || threads.count <= 1) return body(int64_t{0}, count);
  const auto call = [](void* context, int64_t begin, int64_t end) {
    (*static_cast<std::remove_reference_t<Body>*>(context))(begin, end);
  };
  run_ranges(count, threads, call, const_cast<void*>(static_cast<const void*>(&body)));
}

// Calls body(begin, end, scratch) in the same way. Each thread gets `bytes` of working memory.
template <typename Body>
void run_with_scratch(int64_t count, Threads threads, int64_t bytes, Body&& body) {
  parallel_ranges(count, threads, [&](int64_t begin, int64_t end) {
    const ThreadMemory scratch(bytes);
    body(begin, end, scratch.get());
  });
}

}  // namespace darswin
