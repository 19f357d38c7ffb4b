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
//
// With 8 bits, a number of a token is a word of four depths. The sums are integers, so they are
// exact.
#include "../linear.h"

#include "activations.h"
#include "quantize.h"

namespace darswin {
namespace {

constexpr int64_t kL = kLanes<float>;
constexpr int64_t kPart = 128;  // words of the depth; this part of a panel has 24 KB
constexpr int64_t kMostRows = 128, kBlockBytes = 1 << 18;  // of a block of tokens

// By the type of the tokens: the type of a word of the weights, and a register of sums.
template <typename X>
using Word = std::conditional_t<is_same_v<X, float>, float, uint32_t>;
template <typename X>
using Sums = Vector<std::conditional_t<is_same_v<X, float>, float, int32_t>, kL>;

inline float word(const float* token, int64_t k) { return token[k]; }
inline uint32_t word(const uint8_t* token, int64_t k) { return load_bits<uint32_t>(token + 4 * k); }

inline Floats add_product(Floats sums, Floats x, Floats weights) { return sums + x * weights; }

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
template <typename X>
struct Panel {
  const LinearArgs<X>& a;
  int64_t padded, words;  // columns of the layer, and words of the depth
  int64_t first, width;   // of its columns
  const Word<X>* weight;  // (words, width)
  Sums<X>* sums;          // (rows of the block, kPanel): the sums over the earlier parts

  // Computes kRows rows and kWide registers of columns, for the words [begin, end).
  template <int kRows, int kWide>
  [[gnu::noinline]] void tile(int64_t row, int64_t n, int64_t begin, int64_t end,
                              Sums<X>* so_far) const {
    using Weights = Vector<Word<X>, kL>;
    const X* x = a.x + row * a.depth;
    const Word<X>* w = weight + n;
    Sums<X> sum[kRows][kWide] = {};
    for (int64_t k = begin; k < end; ++k) {
      Weights weights[kWide];
      for (int v = 0; v < kWide; ++v) weights[v] = load<Weights>(w + k * width + v * kL);
      each_register<kRows, kWide>([&](int i, int v) {
        sum[i][v] = add_product(sum[i][v], splat<Weights>(word(x + i * a.depth, k)), weights[v]);
      });
    }
    const auto earlier = [&](int i, int v) -> Sums<X>& {
      return so_far[i * kPanel / kL + n / kL + v];
    };
    if (begin > 0) {
      each_register<kRows, kWide>([&](int i, int v) { sum[i][v] += earlier(i, v); });
    }
    if (end < words) {
      each_register<kRows, kWide>([&](int i, int v) { earlier(i, v) = sum[i][v]; });
      return;
    }
    Floats result[kRows][kWide];
    each_register<kRows, kWide>(
        [&](int i, int v) { result[i][v] = value(sum[i][v], first + n + v * kL); });
    const int64_t left = a.columns - first - n, place = row * a.columns + first + n;
    if (a.quantized != nullptr || a.after == After::gelu || left < kWide * kL) {
      Floats copy[kRows][kWide];  // lets the result itself stay in registers
      each_register<kRows, kWide>([&](int i, int v) { copy[i][v] = result[i][v]; });
      finish<kRows, kWide>(copy, place, left);
    } else if (a.after == After::add) {
      each_register<kRows, kWide>([&](int i, int v) {
        float* to = a.out + place + i * a.columns + v * kL;
        store(to, load<Floats>(to) + result[i][v]);
      });
    } else {
      each_register<kRows, kWide>(
          [&](int i, int v) { store(a.out + place + i * a.columns + v * kL, result[i][v]); });
    }
  }

  // Returns the values of the sums of columns `column`, `column` + 1, ...
  Floats value(Sums<X> sum, int64_t column) const {
    const auto* bias = static_cast<const float*>(a.packed) + column;
    if constexpr (is_same_v<X, float>) {
      return sum + load<Floats>(bias);
    } else {
      sum += load_bits<Sums<X>>(bias + 2 * padded);
      // In the order of oneDNN's products, so that the bits are the same.
      const Floats scaled = __builtin_convertvector(sum, Floats) * a.scale;
      return unfused(scaled * load<Floats>(bias + padded)) + load<Floats>(bias);
    }
  }

  // Applies the step after the product to a tile in memory, and writes its first `left` columns to
  // `place` and the following numbers of the result.
  template <int kRows, int kWide>
  [[gnu::noinline]] void finish(const Floats (&tile)[kRows][kWide], int64_t place,
                                int64_t left) const {
    const Quantize quantize(a.quantizer);
    for (int i = 0; i < kRows; ++i) {
      for (int v = 0; v < kWide; ++v) {
        const int64_t to = place + i * a.columns + v * kL, count = smaller(kL, left - v * kL);
        const Floats result = a.after == After::gelu ? gelu(tile[i][v]) : tile[i][v];
        float lanes[kL];
        store(lanes, result);
        if (a.quantized != nullptr) {
          quantize(a.quantized + to, lanes, count);
        } else if (a.after != After::add && count == kL) {
          store(a.out + to, result);
        } else {
          for (int64_t lane = 0; lane < count; ++lane) {
            float& number = a.out[to + lane];
            number = a.after == After::add ? number + lanes[lane] : lanes[lane];
          }
        }
      }
    }
  }

  template <int kRows>
  void columns(int64_t row, int64_t begin, int64_t end, Sums<X>* so_far) const {
    int64_t n = 0;
    for (; n + 3 * kL <= width; n += 3 * kL) tile<kRows, 3>(row, n, begin, end, so_far);
    for (; n + 2 * kL <= width; n += 2 * kL) tile<kRows, 2>(row, n, begin, end, so_far);
    for (; n < width; n += kL) tile<kRows, 1>(row, n, begin, end, so_far);
  }

  void rows(int64_t first_row, int64_t last_row) const {
    for (int64_t begin = 0; begin < words; begin += kPart) {
      const int64_t end = smaller(begin + kPart, words);
      const auto so_far = [&](int64_t row) { return sums + (row - first_row) * kPanel / kL; };
      int64_t row = first_row;
      for (; row + kTileRows <= last_row; row += kTileRows) {
        columns<kTileRows>(row, begin, end, so_far(row));
      }
      for (; row < last_row; ++row) columns<1>(row, begin, end, so_far(row));
    }
  }
};

template <typename X>
void linear_rows(const LinearArgs<X>& a, int64_t begin, int64_t end, int64_t first, int64_t last) {
  Sums<X> sums[kMostRows * kPanel / kL];
  // The block is small enough for its tokens to stay in the second-level cache.
  const int64_t fitting = kBlockBytes / (a.depth * static_cast<int64_t>(sizeof(X)));
  const int64_t most = smaller(kMostRows, round_up(1 + fitting, kTileRows));
  const int64_t padded = padded_columns(a.columns), words = depth_words<X>(a.depth);
  const auto* weight = static_cast<const Word<X>*>(a.packed) + kParameters<X> * padded;
  for (int64_t row = begin; row < end; row += most) {
    for (int64_t column = first * kPanel; column < smaller(last * kPanel, padded);
         column += kPanel) {
      const int64_t width = smaller(kPanel, padded - column);
      const Panel<X> panel{a, padded, words, column, width, weight + column * words, sums};
      panel.rows(row, smaller(row + most, end));
    }
  }
}

}  // namespace

TIER_TABLE(LinearKernels<float>) = {.rows = linear_rows<float>};
#if defined(__AVX512F__)
TIER_TABLE(LinearKernels<uint8_t>) = {.rows = linear_rows<uint8_t>};
#else
TIER_TABLE(LinearKernels<uint8_t>) = {.rows = nullptr};
#endif

}  // namespace darswin
