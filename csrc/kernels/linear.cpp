// The product of a linear layer, for tokens that are in the cache.
//
// A tile of the result has kTileRows tokens and three registers of columns. It stays in registers
// while a loop runs over the depth. Each step multiplies three registers of the weight with one
// number of each token. The weight is packed into panels, so that a tile reads it from front to
// back.
//
// The depth is cut into parts whose weights fit the first-level cache. All tokens use one part
// before the next part starts. Every sum is taken in the same order wherever its tile lies. So the
// results do not depend on the number of tokens or threads.
#include "../linear.h"

#include "math.h"

namespace darswin {
namespace {

constexpr int64_t kL = kLanes<float>;
constexpr int64_t kPart = 128;  // of the depth; this part of a panel has 24 KB
constexpr int64_t kMostRows = 128, kBlockNumbers = 1 << 16;  // of a block of tokens

// Computes x Phi(x), where Phi is the normal distribution. 1 - Phi(|x|) equals e^(-x^2 / 2) times a
// polynomial of 1 / (1 + p |x|), which is fitted for the least relative error.
inline Floats gelu(Floats x) {
  const Floats size = x < 0 ? -x : x;
  const Floats t = 1 / (1 + 0.35f * size);
  constexpr float terms[] = {-2.91455662e-2f, 1.43970054e-1f,  -2.55711114e-1f,
                             1.59170855e-1f,  -2.31077446e-2f, 1.05507193e-1f,
                             1.19833056e-1f,  1.39861846e-1f,  1.39621406e-1f};
  Floats tail = splat<Floats>(terms[0]);
#pragma GCC unroll 16
  for (std::size_t k = 1; k < sizeof(terms) / sizeof(float); ++k) tail = tail * t + terms[k];
  tail = tail * t * exponential_of_negative(size * size * -0.5f);
  return x < 0 ? x * tail : x * (1 - tail);  // also right at infinity
}

// Calls body(i, v) for each register of a tile. The loops are unrolled, because a tile stays in
// registers only then.
template <int kRows, int kWide, typename Body>
[[gnu::always_inline]] inline void each_register(Body body) {
#pragma GCC unroll 8
  for (int i = 0; i < kRows; ++i) {
#pragma GCC unroll 3
    for (int v = 0; v < kWide; ++v) body(i, v);
  }
}

// One panel of columns, for one block of rows.
struct Panel {
  const LinearArgs& a;
  int64_t first, width;  // of its columns
  const float* weight;   // (depth, width)
  float* sums;           // (rows of the block, kPanel): the sums over the earlier parts

  // Computes kRows rows and kWide registers of columns, for the depths [begin, end).
  template <int kRows, int kWide>
  [[gnu::noinline]] void tile(int64_t row, int64_t n, int64_t begin, int64_t end,
                              float* so_far) const {
    const float *x = a.x + row * a.depth, *w = weight + n;
    Floats sum[kRows][kWide] = {};
    for (int64_t k = begin; k < end; ++k) {
      Floats weights[kWide];
      for (int v = 0; v < kWide; ++v) weights[v] = load<Floats>(w + k * width + v * kL);
      each_register<kRows, kWide>(
          [&](int i, int v) { sum[i][v] += x[i * a.depth + k] * weights[v]; });
    }
    const auto earlier = [&](int i, int v) { return so_far + i * kPanel + n + v * kL; };
    if (begin > 0) {
      each_register<kRows, kWide>([&](int i, int v) { sum[i][v] += load<Floats>(earlier(i, v)); });
    }
    if (end < a.depth) {
      each_register<kRows, kWide>([&](int i, int v) { store(earlier(i, v), sum[i][v]); });
      return;
    }
    const float* bias = a.packed + first + n;
    each_register<kRows, kWide>([&](int i, int v) { sum[i][v] += load<Floats>(bias + v * kL); });
    const int64_t left = a.columns - first - n;
    float* out = a.out + row * a.columns + first + n;
    if (a.after == After::gelu || left < kWide * kL) {
      Floats copy[kRows][kWide];  // lets the sums themselves stay in registers
      each_register<kRows, kWide>([&](int i, int v) { copy[i][v] = sum[i][v]; });
      finish<kRows, kWide>(copy, out, left);
    } else if (a.after == After::add) {
      each_register<kRows, kWide>([&](int i, int v) {
        float* to = out + i * a.columns + v * kL;
        store(to, load<Floats>(to) + sum[i][v]);
      });
    } else {
      each_register<kRows, kWide>(
          [&](int i, int v) { store(out + i * a.columns + v * kL, sum[i][v]); });
    }
  }

  // Applies the step after the product to a tile in memory, and writes its first `left` columns.
  template <int kRows, int kWide>
  [[gnu::noinline]] void finish(const Floats (&tile)[kRows][kWide], float* out,
                                int64_t left) const {
    for (int i = 0; i < kRows; ++i) {
      for (int v = 0; v < kWide; ++v) {
        float* to = out + i * a.columns + v * kL;
        const int64_t count = smaller(kL, left - v * kL);
        const Floats result = a.after == After::gelu ? gelu(tile[i][v]) : tile[i][v];
        if (a.after != After::add && count == kL) {
          store(to, result);
          continue;
        }
        for (int64_t lane = 0; lane < count; ++lane) {
          to[lane] = a.after == After::add ? to[lane] + result[lane] : result[lane];
        }
      }
    }
  }

  template <int kRows>
  void columns(int64_t row, int64_t begin, int64_t end, float* so_far) const {
    int64_t n = 0;
    for (; n + 3 * kL <= width; n += 3 * kL) tile<kRows, 3>(row, n, begin, end, so_far);
    for (; n + 2 * kL <= width; n += 2 * kL) tile<kRows, 2>(row, n, begin, end, so_far);
    for (; n < width; n += kL) tile<kRows, 1>(row, n, begin, end, so_far);
  }

  void rows(int64_t first_row, int64_t last_row) const {
    for (int64_t begin = 0; begin < a.depth; begin += kPart) {
      const int64_t end = smaller(begin + kPart, a.depth);
      int64_t row = first_row;
      for (; row + kTileRows <= last_row; row += kTileRows) {
        columns<kTileRows>(row, begin, end, sums + (row - first_row) * kPanel);
      }
      for (; row < last_row; ++row) columns<1>(row, begin, end, sums + (row - first_row) * kPanel);
    }
  }
};

void linear_rows(const LinearArgs& a, int64_t begin, int64_t end, int64_t first, int64_t last) {
  float sums[kMostRows * kPanel];
  // The block is small enough for its tokens to stay in the second-level cache.
  const int64_t most = smaller(kMostRows, round_up(1 + kBlockNumbers / a.depth, kTileRows));
  const int64_t padded = padded_columns(a);
  const float* weight = a.packed + padded;
  for (int64_t row = begin; row < end; row += most) {
    for (int64_t column = first * kPanel; column < smaller(last * kPanel, padded);
         column += kPanel) {
      const int64_t width = smaller(kPanel, padded - column);
      const Panel panel{a, column, width, weight + column * a.depth, sums};
      panel.rows(row, smaller(row + most, end));
    }
  }
}

}  // namespace

TIER_TABLE(LinearKernels) = {.rows = linear_rows};

}  // namespace darswin
