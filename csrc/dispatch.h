// Which tier of kernels runs. For drivers only: kernels/ must not include it (see tier.h).
#pragma once

#include <atomic>
#include <vector>

#include "tier.h"

namespace darswin {

// The tier in use: the best one the CPU has, or what ATEN_CPU_CAPABILITY or set_tier asked for.
Tier current_tier();

const char* tier_name(Tier tier);
std::vector<Tier> available_tiers();  // those of this build that the CPU has, from low to high
bool set_tier(const char* name);      // false where the CPU or the build lacks that tier

// Whether far images are read by gathers where that is possible, or as is faster on this CPU.
enum class Gathers { never, always, by_cpu };
inline std::atomic<Gathers> gathers{Gathers::by_cpu};
bool cpu_is_intel();

template <typename Table, Tier... tiers>
const Table* find_table(Tier tier) {
  const Table* found = nullptr;
  ((tier == tiers ? void(found = &Kernels<Table, tiers>::table) : void()), ...);
  return found;
}

// The kernels of the operator that `Table` belongs to, for the tier in use.
template <typename Table>
const Table& kernels() {
  using enum Tier;
  return *find_table<Table, DARSWIN_TIERS>(current_tier());
}

}  // namespace darswin
