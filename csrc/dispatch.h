// Which tier of kernels runs. For drivers only: kernels/ must not include it (see tier.h).
#pragma once

#include <vector>

#include "tier.h"

namespace darswin {

// The tier in use: the best one the CPU has, or what ATEN_CPU_CAPABILITY or set_tier asked for.
Tier current_tier();

const char* tier_name(Tier tier);
std::vector<Tier> available_tiers();  // those of this build that the CPU has, from low to high
bool set_tier(const char* name);      // false where the CPU or the build lacks that tier

template <typename Table, Tier... tiers>
constexpr const Table* kTables[] = {&Kernels<Table, tiers>::table...};

// The kernels of the operator that `Table` belongs to, for the tier in use.
template <typename Table>
const Table& kernels() {
  using enum Tier;
  return *kTables<Table, DARSWIN_TIERS>[static_cast<int>(current_tier())];
}

}  // namespace darswin
