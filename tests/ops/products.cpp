// Checks the sums of 8-bit layers by the kernels of one tier, in a program that an emulated CPU can
// run. With the argument "fours", it also checks the products of four bytes, which the CPU must
// have.
#include <algorithm>
#include <cstdio>
#include <cstring>
#include <random>
#include <vector>

#include "../../csrc/kernels/linear.cpp"

using namespace darswin;

namespace {

std::mt19937 chance(0);
int drawn(int least, int most) { return std::uniform_int_distribution(least, most)(chance); }

// Returns the number of wrong sums of a layer whose weights, tokens and offsets are random, or all
// extreme.
int wrong(auto* kernel, int64_t rows, int64_t depth, int64_t columns, bool extreme) {
  const int64_t padded = padded_columns(columns), words = depth_words<uint8_t>(depth);
  std::vector<uint8_t> x(rows * depth + kSpare);
  std::vector<int32_t> packed(layer_words<uint8_t>(depth, columns)), sums(rows * columns);
  std::vector<float> out(rows * columns);
  for (auto& token : x) token = static_cast<uint8_t>(extreme ? 255 : drawn(0, 255));
  auto* bytes = reinterpret_cast<int8_t*>(&packed[3 * padded]);
  for (int64_t column = 0; column < columns; ++column) {
    const float one = 1;
    std::memcpy(&packed[padded + column], &one, sizeof one);  // the size of a step
    packed[2 * padded + column] = drawn(-999, 999);
    const int64_t first = column / kPanel * kPanel, width = std::min(kPanel, padded - first);
    for (int64_t row = 0; row < rows; ++row) {
      sums[row * columns + column] = packed[2 * padded + column];
    }
    for (int64_t k = 0; k < depth; ++k) {
      const auto weight = static_cast<int8_t>(extreme ? -128 : drawn(-128, 127));
      bytes[4 * (first * words + k / 4 * width + column - first) + k % 4] = weight;
      for (int64_t row = 0; row < rows; ++row) {
        sums[row * columns + column] += x[row * depth + k] * weight;
      }
    }
  }
  const LinearArgs<uint8_t> args{.x = x.data(),
                                 .packed = packed.data(),
                                 .rows = rows,
                                 .depth = depth,
                                 .columns = columns,
                                 .out = out.data()};
  kernel(args, 0, rows, 0, panel_count(columns));
  int count = 0;
  for (size_t i = 0; i < out.size(); ++i) count += out[i] != static_cast<float>(sums[i]);
  return count;
}

}  // namespace

int main(int count, char** names) {
  const auto& table = Kernels<LinearKernels<uint8_t>, Tier::TIER>::table;
  int found = 0;
  for (const int64_t rows : {1, 3, 8, 21}) {
    for (const int64_t depth : {1, 2, 3, 4, 5, 37, 256, 259, 1030, 2048}) {
      for (const int64_t columns : {1, 17, 48, 101}) {
        for (const bool extreme : {false, true}) {
          found += wrong(table.rows, rows, depth, columns, extreme);
          if (count > 1) found += wrong(table.by_fours, rows, depth, columns, extreme);
        }
      }
    }
  }
  std::printf("%s: %d wrong sums\n", count > 1 ? names[1] : "pairs", found);
  return found != 0;
}
