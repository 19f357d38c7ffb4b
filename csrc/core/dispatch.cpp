// Picks one tier of kernels at load, as ATen does. ATEN_CPU_CAPABILITY may lower the tier, but
// never raise it above the CPU's best.
#include "dispatch.h"

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

}  // namespace

bool cpu_is_intel() {
#if defined(__x86_64__)
  return __builtin_cpu_is("intel");
#else
  return false;
#endif
}

bool cpu_has_vnni() {
#if defined(__x86_64__)
  return __builtin_cpu_supports("avx512vnni");
#else
  return false;
#endif
}

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
