// The instruction-set tiers, and the tables of the kernels of each tier.
//
// csrc/kernels is compiled once per tier, with the instructions of that tier. An inline function
// with external linkage would be in the objects of every tier, and the linker would keep any one
// copy. This could be AVX-512 code, which all CPUs would then run. So everything that kernels/
// compiles is in an unnamed namespace, including this header and those of the operators. Only the
// tables of kernels have external linkage, and their names contain the tier.
#pragma once

namespace darswin {

// From low to high. A build has those that CMakeLists.txt lists in DARSWIN_TIERS: `neon` alone for
// ARM, all others for x86, and `generic` alone for other CPUs.
enum class Tier { generic, neon, avx2, avx512 };

// The kernels of one operator on one tier. `Table` is a struct of function pointers, which the
// operator's header declares. kernels/OPERATOR.cpp defines `table`, on the tier that is being
// compiled, as TIER_TABLE(Table) = {...};
template <typename Table, Tier tier>
struct Kernels {
  static const Table table;
};
#define TIER_TABLE(...) \
  template <>           \
  constinit const __VA_ARGS__ Kernels<__VA_ARGS__, Tier::TIER>::table

}  // namespace darswin
