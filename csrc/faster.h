// Which of two ways to do the same is the faster one on this machine: found by trying.
#pragma once

#include <algorithm>
#include <atomic>
#include <chrono>

namespace darswin {

class Faster {
 public:
  // Calls run(way), way false or true, which must give the same bits. The first calls that are
  // `worth` a trial run both ways in turns and time them; then the way of the shortest time stays.
  template <typename Run>
  void operator()(bool worth, Run run) {
    if (worth && trials < kTrials && !trying.test_and_set()) {
      const Tried done{trying};
      return try_both(run);
    }
    run(way.load());
  }

 private:
  using Clock = std::chrono::steady_clock;
  static constexpr int kTrials = 3;

  struct Tried {
    std::atomic_flag& trying;
    ~Tried() { trying.clear(); }
  };

  template <typename Run>
  void try_both(Run run) {
    for (const bool tried : {trials % 2 == 1, trials % 2 == 0}) {
      const auto start = Clock::now();
      run(tried);
      best[tried] = std::min(best[tried], Clock::now() - start);
    }
    way = best[true] < best[false];
    ++trials;
  }

  std::atomic_flag trying{};  // one caller at a time tries; others run what is known meanwhile
  std::atomic<int> trials{0};
  std::atomic<bool> way{false};
  Clock::duration best[2] = {Clock::duration::max(), Clock::duration::max()};
};

}  // namespace darswin
