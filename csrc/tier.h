// The instruction-set tiers, and where the kernels of each are found.
//
// csrc/kernels is compiled once per tier, with that tier's instructions. An inline function with
// external linkage would come out of every tier's objects, and the linker would keep any one copy:
// perhaps AVX-512 code that all CPUs then run. So whatever kernels/ compiles, this header and those
// of the operators included, stands in an unnamed namespace; only the tables of kernels have
// external linkage, and their names contain the tier.
#pragma once

namespace darswin {

// From low to high. A build has the first few: those that CMakeLists.txt lists in DARSWIN_TIERS,
// which is generic alone where the CPU is not an x86.
enum class Tier { generic, avx2, avx512 };

// The kernels of one operator on one tier. `Table` is a struct of function pointers, which the
// operator's header declares; kernels/OPERATOR.cpp defines `table`, on the tier that is compiled,
// as TIER_TABLE(Table) = {...};
template <typename Table, Tier tier>
struct Kernels {
  static const Table table;
};
#define TIER_TABLE(...) \
  template <>           \
  constinit const __VA_ARGS__ Kernels<__VA_ARGS__, Tier::TIER>::table

}  // namespace darswin
