// Calls the pool of threads (csrc/core/parallel.h) from several threads at once, for
// ThreadSanitizer.
#include <atomic>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <stdexcept>
#include <thread>
#include <vector>

#include "core/parallel.h"

using namespace darswin;

namespace {

constexpr int kCallers = 4, kCalls = 2500;
thread_local bool calls = false;  // whether this thread is a caller
std::atomic<int64_t> helped{0};   // ranges that a helper ran

void check(bool holds, const char* what) {
  if (holds) return;
  std::fprintf(stderr, "wrong: %s\n", what);
  std::exit(1);
}

// Each item is done once, by plain writes that the caller reads afterwards.
void fill(int64_t count, int64_t threads) {
  std::vector<int64_t> items(count);
  run_with_scratch(count, Threads{threads}, 64, [&](int64_t begin, int64_t end, void* scratch) {
    check(begin < end && end <= count, "a range");
    if (!calls) ++helped;
    auto& sum = *static_cast<int64_t*>(scratch);
    for (int64_t k = begin; k < end; ++k) sum = k, items[k] += sum + 1;
  });
  for (int64_t k = 0; k < count; ++k) check(items[k] == k + 1, "an item");
}

void nest(int64_t count, int64_t threads) {
  std::vector<int64_t> sums(count);
  parallel_ranges(count, Threads{threads}, [&](int64_t begin, int64_t end) {
    for (int64_t k = begin; k < end; ++k) {
      std::atomic<int64_t> sum{0};
      parallel_ranges(k, Threads{threads},
                      [&](int64_t first, int64_t last) { sum += last - first; });
      sums[k] = sum;
    }
  });
  for (int64_t k = 0; k < count; ++k) check(sums[k] == k, "a nested call");
}

void fail(int64_t count, int64_t threads) {
  std::vector<int64_t> items(count);
  bool caught = false;
  try {
    parallel_ranges(count, Threads{threads}, [&](int64_t begin, int64_t end) {
      for (int64_t k = begin; k < end; ++k) items[k] = k;
      if (end == count) throw std::runtime_error("the last range");
    });
  } catch (const std::runtime_error&) {
    caught = true;
  }
  check(caught, "an exception");
  items.assign(count, -1);  // a helper that still worked would be a race
}

void call(int caller) {
  calls = true;
  for (int k = 0; k < kCalls; ++k) {
    const int64_t count = 1 + (k * 7 + caller * 13) % 97, threads = 1 + (k + caller) % 6;
    if (k % 16 == 0) {
      nest(count, threads);
    } else if (k % 16 == 1) {
      fail(count, threads);
    } else {
      fill(count, threads);
    }
    if (k % 64 == 0) std::this_thread::sleep_for(std::chrono::microseconds(300));  // helpers sleep
  }
}

}  // namespace

int main() {
  {
    std::vector<std::jthread> callers;
    for (int caller = 0; caller < kCallers; ++caller) callers.emplace_back(call, caller);
  }
  std::printf("%d calls, in which helpers ran %ld ranges\n", kCallers * kCalls, long{helped});
}
