// Picks one tier of kernels at load, as ATen does: ATEN_CPU_CAPABILITY may lower it, never raise it
// above what the CPU has.
#include "dispatch.h"

#include <atomic>
#include <cstdlib>
#include <cstring>

namespace darswin {

namespace generic {
extern const Kernels kernels;
}
#ifdef DARSWIN_X86_TIERS
namespace avx2 {
extern const Kernels kernels;
}
namespace avx512 {
extern const Kernels kernels;
}
#endif

namespace {

// Tiers from low to high; supported() counts how many of them this CPU runs.
const Kernels* const tiers[] = {
    &generic::kernels,
#ifdef DARSWIN_X86_TIERS
    &avx2::kernels,
    &avx512::kernels,
#endif
};

int supported() {
  int count = 1;
#ifdef DARSWIN_X86_TIERS
  __builtin_cpu_init();
  if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) {
    count = 2;
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
        __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512dq")) {
      count = 3;
    }
  }
#endif
  return count;
}

const Kernels* find(const char* tier) {
  for (int i = 0; i < supported(); ++i) {
    if (std::strcmp(tiers[i]->tier, tier) == 0) return tiers[i];
  }
  return nullptr;
}

const Kernels* initial() {
  const Kernels* best = tiers[supported() - 1];
  const char* wanted = std::getenv("ATEN_CPU_CAPABILITY");
  if (wanted == nullptr) return best;
  if (std::strcmp(wanted, "default") == 0) return &generic::kernels;
  // A tier above the CPU's, or a name torch itself warns about, leaves the best one.
  const Kernels* found = find(wanted);
  return found != nullptr ? found : best;
}

std::atomic<const Kernels*>& current() {
  static std::atomic<const Kernels*> chosen{initial()};
  return chosen;
}

}  // namespace

const Kernels& kernels() { return *current().load(std::memory_order_relaxed); }

const char* best_tier() { return tiers[supported() - 1]->tier; }

bool tier_available(const char* tier) { return find(tier) != nullptr; }

bool set_tier(const char* tier) {
  const Kernels* found = find(tier);
  if (found == nullptr) return false;
  current().store(found, std::memory_order_relaxed);
  return true;
}

}  // namespace darswin
