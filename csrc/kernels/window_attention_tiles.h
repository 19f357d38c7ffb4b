// The three steps of attention. Each works on one tile of numbers in registers at a time.
//
// A group is 16 queries, one in each SIMD lane. It fills 1, 2 or 4 registers.
//
// Step one, `transpose`, turns the queries of a group so that each channel is one vector over the
// queries. Step two, `products`, multiplies the group with every key. Its results are vectors over
// the queries too, so that a softmax needs no sum across lanes. Step three, `weighted_sums`,
// multiplies whole rows of values with the probabilities. Here the channels are in the lanes, so
// nothing has to be transposed back. Backward uses the same three steps.
#pragma once

#include "convert.h"

namespace darswin {
namespace {

constexpr int kGroup = 16;

// Rows of d numbers, anywhere in memory.
template <typename T>
struct Rows {
  T* base;
  const int64_t* offset;

  T* operator[](int64_t row) const { return base + offset[row]; }
  Rows from(int64_t row) const { return {base, offset + row}; }
};

// Writes columns[c * kGroup + i] = rows[i][c] for the rows of a group.
template <typename T, typename Dim>
__attribute__((noinline)) void transpose(Rows<const T> rows, Dim d, T* columns) {
  constexpr int kL = kLanes<float>;
  const int64_t squares = sizeof(T) == sizeof(float) ? d / kL * kL : 0;
  if constexpr (sizeof(T) == sizeof(float)) {
    for (int64_t begin = 0; begin < squares; begin += kL) {
      for (int row = 0; row < kGroup; row += kL) {
        Floats square[kL];
#pragma GCC unroll 16
        for (int i = 0; i < kL; ++i) square[i] = load<Floats>(rows[row + i] + begin);
        transpose_square(square, columns + begin * kGroup + row, kGroup);
      }
    }
  }
  for (int i = 0; i < kGroup; ++i) {
    for (int64_t c = squares; c < d; ++c) columns[c * kGroup + i] = rows[i][c];
  }
}

// Calls use(k, v, sum) for each key k < n, where n is a multiple of 8, and for each register v of
// the group. `sum` is the sum over c of columns[c * kGroup + i] * rows[k][c]. Several sums are
// computed at once to hide the latency of the multiply-add.
template <typename T, typename Count, typename Dim, typename Use>
inline void products(const T* columns, Rows<const T> rows, Count n, Dim d, Use use) {
  using V = Vector<T, kLanes<T>>;
  constexpr int kVectors = kGroup / kLanes<T>;
  constexpr int kRows = kVectors < 8 ? 8 / kVectors : 1;
  for (int64_t k = 0; k < n; k += kRows) {
    V sums[kRows][kVectors] = {};
    const T* row[kRows];
#pragma GCC unroll 8
    for (int r = 0; r < kRows; ++r) row[r] = rows[k + r];
    for (int64_t c = 0; c < d; ++c) {
      V column[kVectors];
#pragma GCC unroll 8
      for (int v = 0; v < kVectors; ++v) {
        column[v] = load<V>(columns + c * kGroup + v * kLanes<T>);
      }
#pragma GCC unroll 8
      for (int r = 0; r < kRows; ++r) {
        const V factor = splat<V>(row[r][c]);
#pragma GCC unroll 8
        for (int v = 0; v < kVectors; ++v) sums[r][v] += column[v] * factor;
      }
    }
#pragma GCC unroll 8
    for (int r = 0; r < kRows; ++r) {
#pragma GCC unroll 8
      for (int v = 0; v < kVectors; ++v) use(k + r, v, sums[r][v]);
    }
  }
}

// The weight of row i for summand j is weight[i * kRow + j * kSummand].
template <int kRow, int kSummand, typename T>
struct Weights {
  const T* weight;
  T operator()(int64_t i, int64_t j) const { return weight[i * kRow + j * kSummand]; }
  Weights from(int64_t i, int64_t j) const { return {weight + i * kRow + j * kSummand}; }
};

// The factor of row i is factor[i * step].
template <typename T>
struct Factors {
  const T* factor;
  int64_t step;
  T operator()(int64_t i) const { return factor[i * step]; }
  Factors from(int64_t i) const { return {factor + i * step, step}; }
};

// How results are stored: in place of the old values, added to them, or in place of them and past
// the caches.
enum class Into { kCache, kSum, kMemory };

// Computes channels [0, kColumns vectors) of the first kRows rows of `weighted_sums`.
template <typename V, int kRows, int kColumns, typename W, typename T>
inline void weighted_tile(W weights, Rows<const T> from, int64_t summands, Rows<T> to, int64_t rows,
                          Factors<T> factors, Into into) {
  constexpr int kL = sizeof(V) / sizeof(T);
  V sums[kRows][kColumns] = {};
  for (int64_t j = 0; j < summands; ++j) {
    V x[kColumns];
#pragma GCC unroll 4
    for (int v = 0; v < kColumns; ++v) x[v] = load<V>(from[j] + v * kL);
#pragma GCC unroll 8
    for (int r = 0; r < kRows; ++r) {
      const V weight = splat<V>(weights(r, j));
#pragma GCC unroll 4
      for (int v = 0; v < kColumns; ++v) sums[r][v] += weight * x[v];
    }
  }
#pragma GCC unroll 8
  for (int r = 0; r < kRows; ++r) {
    if (r >= rows) return;
#pragma GCC unroll 4
    for (int v = 0; v < kColumns; ++v) {
      T* out = to[r] + v * kL;
      V sum = sums[r][v] * splat<V>(factors(r));
      if (into == Into::kSum) sum += load<V>(out);
      into == Into::kMemory ? stream(out, sum) : store(out, sum);
    }
  }
}

// Computes to[i][c] = factors(i) * sum_j weights(i, j) * from[j][c] for i < rows. Weights are
// read up to the next multiple of 8 rows. Long sums are cut into pieces, because the rounding error
// of a sum grows with its length. Only sums of one piece can be stored past the caches.
template <typename W, typename T, typename Summands, typename Count, typename Dim>
__attribute__((noinline)) void weighted_sums(W weights, Rows<const T> from, Summands summands,
                                             Rows<T> to, Count rows, Dim d, Factors<T> factors,
                                             Into into) {
  constexpr int kL = kLanes<T>, kRows = kTileRows, kPiece = 64;
  for (int64_t j = 0; j < summands; j += kPiece, into = Into::kSum) {
    const int64_t piece = smaller(summands - j, kPiece);
    for (int64_t i = 0; i < rows; i += kRows) {
      const auto tile = [&]<typename V, int kColumns>(int64_t c) {
        const Rows<const T> source{from.base + c, from.offset + j};
        const Rows<T> target{to.base + c, to.offset + i};
        weighted_tile<V, kRows, kColumns>(weights.from(i, j), source, piece, target, rows - i,
                                          factors.from(i), into);
      };
      int64_t c = 0;
      for (; c + 2 * kL <= d; c += 2 * kL) tile.template operator()<Vector<T, kL>, 2>(c);
      for (; c + kL <= d; c += kL) tile.template operator()<Vector<T, kL>, 1>(c);
      for (; c < d; ++c) tile.template operator()<T, 1>(c);
    }
  }
}

// Converts rows of bfloat16 to float32, and back. Of two registers of channels, the even channels
// come first and the odd ones second. This needs no shuffle, and no step above depends on the order
// of the channels.
inline void widen(const bfloat16* from, int64_t d, float* to) {
  constexpr int kL = kLanes<float>;
  using Bits = Vector<uint32_t, kL>;
  int64_t c = 0;
  for (; c + 2 * kL <= d; c += 2 * kL) {
    const Bits pairs = load_bits<Bits>(from + c);
    store_bits(to + c, pairs << 16);
    store_bits(to + c + kL, pairs & 0xFFFF0000);
  }
  for (; c < d; ++c) to[c] = load<float>(from + c);
}
inline void narrow(const float* from, int64_t d, bfloat16* to) {
  constexpr int kL = kLanes<float>;
  int64_t c = 0;
  for (; c + 2 * kL <= d; c += 2 * kL) {
    const auto even = rounded(load<Floats>(from + c)), odd = rounded(load<Floats>(from + c + kL));
    store_bits(to + c, (even >> 16) | (odd & 0xFFFF0000));
  }
  for (; c < d; ++c) store(to + c, from[c]);
}

}  // namespace
}  // namespace darswin
