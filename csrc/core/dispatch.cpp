// Picks one tier of kernels at load, as ATen does. ATEN_CPU_CAPABILITY may lower the tier, but
// never raise it above the CPU's best.
#include "dispatch.h"

#if defined(__x86_64__)
#  include <cpuid.h>
#elif defined(__aarch64__) && defined(__linux__)
#  include <sys/auxv.h>
#endif
#if defined(__linux__)
#  include <sys/syscall.h>
#  include <unistd.h>
#endif

#include <algorithm>
#include <atomic>
#include <cstdlib>
#include <cstring>
#include <optional>

namespace darswin {
namespace {

bool has([[maybe_unused]] Tier tier) {
#if defined(__x86_64__)
  __builtin_cpu_init();
  const bool avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
  if (tier == Tier::avx2) return avx2;
  if (tier == Tier::avx512) {
    return avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
           __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512dq");
  }
#endif
  return true;
}

std::optional<Tier> find(const char* name) {
  for (const Tier tier : available_tiers()) {
    if (std::strcmp(tier_name(tier), name) == 0) return tier;
  }
  return std::nullopt;
}

Tier initial() {
  const Tier best = available_tiers().back();
  const char* wanted = std::getenv("ATEN_CPU_CAPABILITY");
  if (wanted == nullptr) return best;
  if (std::strcmp(wanted, "default") == 0) return available_tiers().front();
  // If the CPU lacks the tier, or the name is one that torch itself warns about, the best tier
  // stays.
  return find(wanted).value_or(best);
}

std::atomic<Tier> current{initial()};
std::atomic<ByteProducts> most{ByteProducts::tiles};

bool cpu_has_fours([[maybe_unused]] Tier tier) {
#if defined(__x86_64__)
  if (tier == Tier::avx512) return __builtin_cpu_supports("avx512vnni");
  unsigned a = 0, b = 0, c = 0, d = 0;  // compilers do not know the name of AVX-VNNI yet
  return __get_cpuid_count(7, 1, &a, &b, &c, &d) && (a >> 4 & 1);
#elif defined(__aarch64__) && defined(__linux__)
  return (getauxval(AT_HWCAP) & HWCAP_ASIMDDP) != 0;
#elif defined(__aarch64__) && defined(__APPLE__)
  return true;
#else
  return false;
#endif
}

// The registers are large, so a process has them only after it has asked for them.
bool has_tiles() {
#if defined(__x86_64__) && defined(__linux__)
  constexpr unsigned kAmx = 1 << 24 | 1 << 25;      // the tiles, and their products of bytes
  constexpr int kRequest = 0x1023, kTileData = 18;  // ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA
  unsigned a = 0, b = 0, c = 0, d = 0;
  return __get_cpuid_count(7, 0, &a, &b, &c, &d) && (d & kAmx) == kAmx &&
         syscall(SYS_arch_prctl, kRequest, kTileData) == 0;
#else
  return false;
#endif
}

}  // namespace

bool cpu_is_intel() {
#if defined(__x86_64__)
  return __builtin_cpu_is("intel");
#else
  return false;
#endif
}

ByteProducts byte_products() {
  using enum ByteProducts;
  const auto best = [](Tier tier) { return cpu_has_fours(tier) ? fours : pairs; };
  static const auto avx512 = has_tiles() ? tiles : best(Tier::avx512), others = best(Tier::avx2);
  const Tier tier = current_tier();
  const auto found = tier == Tier::avx512 ? avx512 : tier == Tier::generic ? pairs : others;
  return std::min(found, most.load(std::memory_order_relaxed));
}

void limit_byte_products(ByteProducts limit) { most.store(limit, std::memory_order_relaxed); }

Tier current_tier() { return current.load(std::memory_order_relaxed); }

const char* tier_name(Tier tier) {
  constexpr const char* names[] = {"generic", "neon", "avx2", "avx512"};
  return names[static_cast<int>(tier)];
}

std::vector<Tier> available_tiers() {
  using enum Tier;
  std::vector<Tier> tiers{DARSWIN_TIERS};
  std::erase_if(tiers, [](Tier tier) { return !has(tier); });
  return tiers;
}

bool set_tier(const char* name) {
  const std::optional<Tier> found = find(name);
  if (found.has_value()) current.store(*found, std::memory_order_relaxed);
  return found.has_value();
}

}  // namespace darswin
