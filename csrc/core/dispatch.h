// Selects the tier of kernels that runs. Only drivers may include this, not kernels/ (see tier.h).
#pragma once

#include <vector>

#include "../tier.h"

namespace darswin {

// The tier in use: the best tier of the CPU, or the one that ATEN_CPU_CAPABILITY or set_tier asked
// for.
Tier current_tier();

const char* tier_name(Tier tier);
std::vector<Tier> available_tiers();  // this build's tiers that the CPU has, low to high
bool set_tier(const char* name);      // false if the CPU or the build lacks that tier

bool cpu_is_intel();

// How to multiply bytes: as pairs of 16 bits, by the tier's instruction for the products of four,
// or by the tiles of AMX. The results are the same.
enum class ByteProducts { pairs, fours, tiles };

// The best way that this CPU, the tier and the limit have. The first call asks Linux for the tiles.
ByteProducts byte_products();
void limit_byte_products(ByteProducts most);

template <typename Table, Tier... tiers>
const Table* find_table(Tier tier) {
  const Table* found = nullptr;
  ((tier == tiers ? void(found = &Kernels<Table, tiers>::table) : void()), ...);
  return found;
}

// Returns the kernels of the operator that `Table` belongs to, for the tier in use.
template <typename Table>
const Table& kernels() {
  using enum Tier;
  return *find_table<Table, DARSWIN_TIERS>(current_tier());
}

}  // namespace darswin
