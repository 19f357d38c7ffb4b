// Products of matrices that are in cache, for linear layers that are fused with what feeds them.
//
// A tile of the result stays in registers while a loop runs over the depth: each step multiplies a
// few whole registers of b with a few single values of a. The tile is as large as the registers
// allow, so that every value is used often once it is loaded.
#pragma once

#include "simd.h"

namespace darswin {
namespace {

// c[i * c_row + n] += sum over k < depth of a[i * a_row + k * a_column] * b[k * b_row + n] for rows
// i < kRows and kWide registers of n.
template <int kRows, int kWide, typename T>
[[gnu::noinline]] void add_tile(int64_t depth, const T* a, int64_t a_row, int64_t a_column,
                                const T* b, int64_t b_row, T* c, int64_t c_row) {
  constexpr int lanes = kLanes<T>;
  using V = Vector<T, lanes>;
  V sum[kRows][kWide];
  for (int i = 0; i < kRows; ++i) {
    for (int w = 0; w < kWide; ++w) sum[i][w] = load<V>(c + i * c_row + w * lanes);
  }
  for (int64_t k = 0; k < depth; ++k, a += a_column, b += b_row) {
    V row[kWide];
    for (int w = 0; w < kWide; ++w) row[w] = load<V>(b + w * lanes);
    for (int i = 0; i < kRows; ++i) {
      for (int w = 0; w < kWide; ++w) sum[i][w] += a[i * a_row] * row[w];
    }
  }
  for (int i = 0; i < kRows; ++i) {
    for (int w = 0; w < kWide; ++w) store(c + i * c_row + w * lanes, sum[i][w]);
  }
}

template <int kWide, typename T>
void add_columns(int64_t rows, int64_t depth, const T* a, int64_t a_row, int64_t a_column,
                 const T* b, int64_t b_row, T* c, int64_t c_row) {
  int64_t i = 0;
  for (; i + kTileRows <= rows; i += kTileRows) {
    add_tile<kTileRows, kWide>(depth, a + i * a_row, a_row, a_column, b, b_row, c + i * c_row,
                               c_row);
  }
  for (; i < rows; ++i) {
    add_tile<1, kWide>(depth, a + i * a_row, a_row, a_column, b, b_row, c + i * c_row, c_row);
  }
}

// c (rows, columns) += a (rows, depth) * b (depth, columns). Rows of b and c are contiguous,
// columns a multiple of the lanes; a may be transposed.
template <typename T>
void add_product(int64_t rows, int64_t columns, int64_t depth, const T* a, int64_t a_row,
                 int64_t a_column, const T* b, int64_t b_row, T* c, int64_t c_row) {
  constexpr int64_t lanes = kLanes<T>;
  constexpr int64_t most = 128;  // depth of a panel of b that stays in the nearest cache
  for (int64_t k = 0; k < depth; k += most) {
    const int64_t part = smaller(depth - k, most);
    const T *from = a + k * a_column, *panel = b + k * b_row;
    int64_t n = 0;
    for (; n + 3 * lanes <= columns; n += 3 * lanes) {
      add_columns<3>(rows, part, from, a_row, a_column, panel + n, b_row, c + n, c_row);
    }
    for (; n < columns; n += lanes) {
      add_columns<1>(rows, part, from, a_row, a_column, panel + n, b_row, c + n, c_row);
    }
  }
}

}  // namespace
}  // namespace darswin
