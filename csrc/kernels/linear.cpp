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
// With 8 bits, a number of a token is a word of four depths, if the CPU adds the products of four
// bytes in one instruction. Other CPUs add the products of two numbers of 16 bits. For them, a word
// is split into two words of two depths: those of a part of the weights once for all tokens, and
// those of a few tokens once for all columns of a panel. With AMX, a tile of sums has 16 tokens,
// and an instruction adds the products of 16 words of each. Every way the sums are integers and
// exact, so the results are the same.
#include "../linear.h"

#include "activations.h"
#include "pack.h"
#include "quantize.h"

namespace darswin {
namespace {

constexpr int64_t kPart = 128;   // words of a token in a tile; this part of a panel has 24 KB
constexpr int64_t kTurned = 16;  // tokens of a transposed matrix: a line of the cache
constexpr int64_t kTile = 16;    // tokens and words of a tile of AMX
constexpr int64_t kMostRows = 128, kBlockBytes = 3 << 17;  // of a block of tokens

// The kinds of products. X is the type of a token's numbers, Word that of a word in a tile, and Sum
// that of a sum. A word of the layer becomes kSplit words in a tile. If kCopies, a tile reads a
// copy of its tokens. If kStarts, the sums do not start at zero. If kInTiles, AMX has the tiles.
struct Numbers {
  using X = float;
  using Word = float;
  using Sum = float;
  static constexpr int64_t kSplit = 1;
  static constexpr bool kCopies = false, kStarts = false, kInTiles = false;
  static Floats add(Floats sums, Floats x, Floats weights) { return sums + x * weights; }
};

struct Bytes {
  using X = uint8_t;
  using Word = uint32_t;
  using Sum = int32_t;
  static constexpr bool kStarts = false, kInTiles = false;
};

// Four bytes in a word. If the CPU's bytes are signed, the copy of a token is 128 less.
struct Fours : Bytes {
  [[maybe_unused]] static constexpr int64_t kSplit = 1;
  [[maybe_unused]] static constexpr bool kCopies = kSignedFours, kStarts = kSignedFours;
  template <typename S, typename W>
  static S add(S sums, W x, W weights) {
    return add_fours(sums, x, weights);
  }
  static void copy(const uint8_t* token, int64_t words, uint32_t* to) {
    for (int64_t k = 0; k < words; ++k) to[k] = load_bits<uint32_t>(token + 4 * k) ^ 0x80808080;
  }
};

// Two numbers of 16 bits in a word.
struct Pairs : Bytes {
  static constexpr int64_t kSplit = 2;
  static constexpr bool kCopies = true;
  template <typename S, typename W>
  static S add(S sums, W x, W weights) {
    return add_pairs(sums, x, weights);
  }
  static void copy(const uint8_t* token, int64_t words, uint32_t* to) {
    split<uint16_t>(token, words, to);
  }
  // Writes the first and the third byte of each word, and behind these words all the others. The
  // sign of Half is that of the bytes.
  template <typename Half>
  static void split(const void* from, int64_t words, uint32_t* to) {
    const auto* bytes = static_cast<const uint8_t*>(from);
    const auto some = [&]<int kWords>(int64_t k) {
      const auto both = load_bits<Vector<Half, 2 * kWords>>(bytes + 4 * k);
      store_bits(to + k, (both << 8) >> 8);
      store_bits(to + words + k, both >> 8);
    };
    int64_t k = 0;
    for (; k + kL <= words; k += kL) some.template operator()<kL>(k);
    for (; k + 4 <= words; k += 4) some.template operator()<4>(k);
    for (; k < words; ++k) some.template operator()<1>(k);
  }
};

// The same in tiles of AMX, which only some tiers have.
struct AmxTiles;
struct Tiles : Fours {
  [[maybe_unused]] static constexpr bool kInTiles = true;
  using Amx = AmxTiles;
};

inline float word(const float* token, int64_t k) { return token[k]; }
[[maybe_unused]] inline uint32_t word(const uint8_t* token, int64_t k) {
  return load_bits<uint32_t>(token + 4 * k);
}
inline uint32_t word(const uint32_t* token, int64_t k) { return token[k]; }

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
template <typename P>
struct Panel {
  using X = typename P::X;
  using Word = typename P::Word;
  using Weights = Vector<Word, kL>;
  using Sums = Vector<typename P::Sum, kL>;
  using Token = std::conditional_t<P::kCopies, Word, X>;  // what a tile reads

  const LinearArgs<X>& a;
  int64_t padded, words;  // columns of the layer, and words of the depth
  int64_t first, width;   // of its columns
  const Word* weight;     // (words, width)
  Sums* sums;             // (rows of the block, kPanel): the sums over the earlier parts

  // A part of the depth: a piece of one segment of the tokens, or all segments if they are short.
  struct Part {
    int64_t begin, end, segments, words;  // words of the layer; in a tile, those of a segment
    const Word* weight;                   // (words in a tile, width)
    Sums* start;                          // (kPanel,): where the sums start, if not at zero
  };

  // Computes kRows rows and kWide registers of columns. The rows of x are `stride` apart, and the
  // words of a row `step`.
  template <int kRows, int kWide>
  [[gnu::noinline]] void tile(const Token* x, int64_t stride, int64_t step, const Part& part,
                              int64_t row, int64_t n, Sums* so_far) const {
    const Word* w = part.weight + n;
    Sums sum[kRows][kWide] = {};
    if constexpr (P::kStarts) {
      each_register<kRows, kWide>([&](int i, int v) { sum[i][v] = part.start[n / kL + v]; });
    }
    for (int64_t segment = 0; segment < part.segments; ++segment, x += a.pitch) {
      for (int64_t k = 0; k < part.words * step; k += step, w += width) {
        Weights weights[kWide];
        for (int v = 0; v < kWide; ++v) weights[v] = load<Weights>(w + v * kL);
        each_register<kRows, kWide>([&](int i, int v) {
          sum[i][v] = P::add(sum[i][v], splat<Weights>(word(x + i * stride, k)), weights[v]);
        });
      }
    }
    const auto earlier = [&](int i, int v) -> Sums& {
      return so_far[i * kPanel / kL + n / kL + v];
    };
    if (part.begin > 0) {
      each_register<kRows, kWide>([&](int i, int v) { sum[i][v] += earlier(i, v); });
    }
    if (part.end < words) {
      each_register<kRows, kWide>([&](int i, int v) { earlier(i, v) = sum[i][v]; });
      return;
    }
    write(sum, row, n);
  }

  // Writes the results of the sums of a tile.
  template <int kRows, int kWide>
  [[gnu::always_inline]] inline void write(const Sums (&sum)[kRows][kWide], int64_t row,
                                           int64_t n) const {
    Floats result[kRows][kWide];
    each_register<kRows, kWide>(
        [&](int i, int v) { result[i][v] = value(sum[i][v], first + n + v * kL); });
    const int64_t left = a.columns - first - n, place = row * a.out_stride + first + n;
    if (a.after == After::relu) {
      each_register<kRows, kWide>([&](int i, int v) { result[i][v] = relu(result[i][v]); });
    }
    if (a.quantized != nullptr || a.after == After::gelu || left < kWide * kL) {
      Floats copy[kRows][kWide];  // lets the result itself stay in registers
      each_register<kRows, kWide>([&](int i, int v) { copy[i][v] = result[i][v]; });
      finish<kRows, kWide>(copy, place, left);
    } else if (a.after == After::add) {
      each_register<kRows, kWide>([&](int i, int v) {
        float* to = a.out + place + i * a.out_stride + v * kL;
        store(to, load<Floats>(to) + result[i][v]);
      });
    } else {
      each_register<kRows, kWide>(
          [&](int i, int v) { store(a.out + place + i * a.out_stride + v * kL, result[i][v]); });
    }
  }

  // Returns the values of the sums of columns `column`, `column` + 1, ...
  Floats value(Sums sum, int64_t column) const {
    const auto* bias = static_cast<const float*>(a.packed) + column;
    if constexpr (is_same_v<X, float>) {
      return sum + load<Floats>(bias);
    } else {
      // Unsigned: the parameters of a file may be any, and an int must not overflow.
      using Words = Vector<uint32_t, kL>;
      sum = (Sums)((Words)sum + load_bits<Words>(bias + 2 * padded));
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
    const After after = a.after;
    const int64_t out_stride = a.out_stride;
    float* const out = a.out;
    uint8_t* const quantized = a.quantized;
    for (int i = 0; i < kRows; ++i) {
      for (int v = 0; v < kWide; ++v) {
        const int64_t to = place + i * out_stride + v * kL;
        const int64_t count = left < v * kL ? 0 : smaller(kL, left - v * kL);
        const Floats result = after == After::gelu ? gelu(tile[i][v]) : tile[i][v];
        if (quantized != nullptr && count < kL) {
          float lanes[kL];
          store(lanes, result);
          for (int64_t lane = 0; lane < count; ++lane) quantize(quantized + to + lane, lanes[lane]);
        } else if (quantized != nullptr) {
          quantize(quantized + to, result);
        } else if (after == After::add) {
          store_first(out + to, load_first(out + to, count) + result, count);
        } else {
          store_first(out + to, result, count);
        }
      }
    }
  }

  // Computes the columns of a tile of tokens, or of fewer at the end, with all sums in memory.
  template <int kWide>
  void wide_tile(const Part& part, int64_t row, int64_t count, Sums* so_far) const {
    P::Amx::template multiply<kWide>(a.x + row * a.depth + part.begin * kDepths<X>, a.depth,
                                     part.weight, width, part.words, so_far, kPanel * sizeof(Word),
                                     part.begin == 0);
    if (part.end < words) return;
    int64_t i = 0;
    for (; i + kTileRows <= count; i += kTileRows) written<kTileRows, kWide>(row + i, so_far, i);
    for (; i < count; ++i) written<1, kWide>(row + i, so_far, i);
  }
  template <int kRows, int kWide>
  [[gnu::noinline]] void written(int64_t row, const Sums* so_far, int64_t first) const {
    Sums sum[kRows][kWide];
    each_register<kRows, kWide>(
        [&](int i, int v) { sum[i][v] = so_far[(first + i) * kPanel / kL + v]; });
    write(sum, row, 0);
  }

  template <int kRows>
  void columns(const X* token, const Part& part, int64_t row, Sums* so_far) const {
    if constexpr (P::kCopies) {
      Word copy[kRows * kPart];
      for (int i = 0; i < kRows; ++i) {
        P::copy(token + i * a.stride, part.end - part.begin, copy + i * kPart);
      }
      tiles<kRows>(copy, kPart, 1, part, row, so_far);
    } else {
      tiles<kRows>(token, a.stride, 1, part, row, so_far);
    }
  }
  template <int kRows>
  void tiles(const Token* x, int64_t stride, int64_t step, const Part& part, int64_t row,
             Sums* so_far) const {
    int64_t n = 0;
    for (; n + 3 * kL <= width; n += 3 * kL) tile<kRows, 3>(x, stride, step, part, row, n, so_far);
    for (; n + 2 * kL <= width; n += 2 * kL) tile<kRows, 2>(x, stride, step, part, row, n, so_far);
    for (; n < width; n += kL) tile<kRows, 1>(x, stride, step, part, row, n, so_far);
  }

  // The same for a few tokens of a transposed matrix, of which tiles read a copy: the words of a
  // token lie far apart.
  void turned(const X* token, int64_t count, const Part& part, int64_t row, Sums* so_far) const {
    X copy[kTurned * kPart];
    for (int64_t k = 0; k < part.words; ++k, token += a.step) {
      X* const to = copy + k * kTurned;
      if (count == kTurned) store(to, load<Vector<X, kTurned>>(token));
      if (count < kTurned) __builtin_memcpy(to, token, count * sizeof(X));
    }
    const auto next = [&]<int kRows>(int64_t i) {
      tiles<kRows>(copy + i, 1, kTurned, part, row + i, so_far + i * kPanel / kL);
    };
    int64_t i = 0;
    for (; i + kTileRows <= count; i += kTileRows) next.template operator()<kTileRows>(i);
    for (; i < count; ++i) next.template operator()<1>(i);
  }

  void rows(int64_t first_row, int64_t last_row) const {
    constexpr int64_t kStep = kPart / P::kSplit;
    [[maybe_unused]] alignas(64) Word split[P::kSplit > 1 ? kPart * kPanel : 1];
    [[maybe_unused]] Sums start[kPanel / kL];
    const int64_t segment = words / a.segments;  // words
    for (int64_t begin = 0, end; begin < words; begin = end) {
      end = words <= kStep ? words : begin + smaller(kStep, segment - begin % segment);
      const int64_t count = end - begin, segments = units(count, segment);
      Part part{begin, end, segments, count / segments * P::kSplit, weight + begin * width, start};
      if constexpr (P::kSplit > 1) {
        P::template split<int16_t>(part.weight, count * width, split);
        // The next part, or that of the next panel, follows in memory.
        const Word* next = part.weight + count * width;
        for (int64_t k = 0; k < count * width; k += 64 / sizeof(Word)) fetch(next + k);
        part.weight = split;
      }
      if constexpr (P::kStarts) add_128(part);
      const auto so_far = [&](int64_t row) { return sums + (row - first_row) * kPanel / kL; };
      int64_t row = first_row;
      if constexpr (P::kInTiles) {
        const bool whole = words <= kStep;  // then the sums of one tile are enough
        for (; row < last_row; row += kTile) {
          const int64_t count = smaller(kTile, last_row - row);
          if (count < kTile) P::Amx::shape(count, words % kTile);
          Sums* const to = so_far(whole ? first_row : row);
          if (width == 3 * kTile) wide_tile<3>(part, row, count, to);
          if (width == 2 * kTile) wide_tile<2>(part, row, count, to);
          if (width == kTile) wide_tile<1>(part, row, count, to);
          if (count < kTile) P::Amx::shape(kTile, words % kTile);
        }
        continue;
      }
      while (row < last_row) {
        const int64_t line = row / a.run, last = smaller((line + 1) * a.run, last_row);
        const X* const first = a.x + line * (a.pitch - a.run * a.stride) +
                               begin / segment * a.pitch + begin % segment * kDepths<X> * a.step;
        if constexpr (is_same_v<Token, float>) {
          for (; a.step > 1 && row < last; row += kTurned) {
            turned(first + row * a.stride, smaller(kTurned, last - row), part, row, so_far(row));
          }
        }
        for (; row + kTileRows <= last; row += kTileRows) {
          columns<kTileRows>(first + row * a.stride, part, row, so_far(row));
        }
        for (; row < last; ++row) columns<1>(first + row * a.stride, part, row, so_far(row));
      }
    }
  }

  // Makes the sums start at 128 times the sums of the weights.
  void add_128(const Part& part) const {
    for (int64_t n = 0; n < width; n += kL) {
      Sums sum{};
      for (int64_t k = 0; k < part.words; ++k) {
        sum = P::add(sum, splat<Weights>(0x80808080), load<Weights>(part.weight + k * width + n));
      }
      part.start[n / kL] = -sum;  // each byte is -128
    }
  }
};

template <typename P>
void linear_rows(const LinearArgs<typename P::X>& a, int64_t begin, int64_t end, int64_t first,
                 int64_t last) {
  using X = typename P::X;
  using Word = typename P::Word;
  typename Panel<P>::Sums sums[kMostRows * kPanel / kL];
  // The block is small enough for its tokens to stay in the second-level cache. Each block reads
  // the whole weight again, so small blocks lose where the weight is larger than the caches.
  const int64_t fitting = kBlockBytes / (a.stride * static_cast<int64_t>(sizeof(X)));
  const int64_t most = smaller(kMostRows, round_up(1 + fitting, kTileRows));
  const int64_t padded = padded_columns(a.columns), words = depth_words<X>(a.depth);
  const auto* weight = static_cast<const Word*>(a.packed) + kParameters<X> * padded;
  if constexpr (P::kInTiles) P::Amx::shape(kTile, words % kTile);
  for (int64_t row = begin; row < end; row += most) {
    for (int64_t column = first * kPanel; column < smaller(last * kPanel, padded);
         column += kPanel) {
      const int64_t width = smaller(kPanel, padded - column);
      const Panel<P> panel{a, padded, words, column, width, weight + column * words, sums};
      panel.rows(row, smaller(row + most, end));
    }
  }
  if constexpr (P::kInTiles) P::Amx::release();
}

template <typename P, bool kIsThere>
constexpr auto if_there() -> decltype(&linear_rows<P>) {
  if constexpr (kIsThere) {
    return linear_rows<P>;
  } else {
    return nullptr;
  }
}

}  // namespace

TIER_TABLE(LinearKernels<float>) = {
    .rows = linear_rows<Numbers>, .pack = pack, .pack_rows = pack_rows};
TIER_TABLE(LinearKernels<uint8_t>) = {.rows = linear_rows<Pairs>,
                                      .by_fours = if_there<Fours, kHasFours>(),
                                      .by_tiles = if_there<Tiles, kHasTiles>()};

}  // namespace darswin
