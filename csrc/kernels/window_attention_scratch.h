// The sizes, the positions of tokens and the working memory of window attention: everything except
// the arithmetic.
#pragma once

#include "../window_attention.h"
#include "arena.h"
#include "window_attention_tiles.h"

namespace darswin {
namespace {

// If a window has at most this many tokens, each head keeps tables of all pairs of tokens.
constexpr int64_t kPairTokens = 64;
// Prefetching is worth its cost from this many bytes of qkv on.
constexpr int64_t kCache = int64_t{4} << 20;

// A size that the compiler knows, or 0 if only the call knows it.
template <int64_t kKnown>
struct Size {
  int64_t size;
  operator int64_t() const { return kKnown > 0 ? kKnown : size; }
};

// The sizes of one call. kTokens and kDim are n and d if the compiler knows them. A window of one
// sector is treated as a window of one ring: it has the same tokens in the same order, but in one
// long run.
template <int64_t kTokens, int64_t kDim>
struct Shape {
  Size<kTokens> n;                         // tokens of a window
  Size<round_up(kTokens, kGroup)> padded;  // n, rounded up to whole groups
  Size<round_up(kTokens, 8)> eights;       // n, rounded up to a multiple of 8
  Size<kDim> d;
  int64_t heads;
  int64_t windows_r, windows_a, map_windows;  // windows along the axes; of one image
  int64_t runs, run;       // a window is `runs` runs of `run` neighbouring tokens each
  int64_t table_a, table;  // width and size of one head's bias table
  bool pairs;              // there are tables of all pairs
  bool far;                // the map is too large for the caches
  bool quantized;          // results are 8 bits

  template <typename S>
  explicit Shape(const WindowAttentionArgs<S>& a)
      : n{a.window_r * a.window_a},
        padded{round_up(n, kGroup)},
        eights{round_up(n, 8)},
        d{a.head_dim},
        heads(a.heads),
        windows_r(a.rings / a.window_r),
        windows_a(a.sectors / a.window_a),
        map_windows(windows_r * windows_a),
        runs(a.window_a == 1 ? 1 : a.window_r),
        run(n / runs),
        table_a(2 * run - 1),
        table((2 * runs - 1) * table_a),
        pairs(n <= kPairTokens),
        far(a.windows * n * 3 * heads * d * static_cast<int64_t>(sizeof(S)) > kCache),
        quantized(a.quantized != nullptr) {}

  // Calls body(key, query, count, index) for all keys and the queries of [begin, end). A call
  // covers a run of queries whose biases are neighbours too. The first of these biases is at
  // `index` of the table.
  template <typename Body>
  void for_pairs(int64_t begin, int64_t end, Body body) const {
    const int64_t first_run = begin / run;
    for (int64_t k_run = 0, key = 0; k_run < runs; ++k_run) {
      for (int64_t k = 0; k < run; ++k, ++key) {
        int64_t query = begin, place = begin - first_run * run;
        int64_t row = (first_run - k_run + runs - 1) * table_a + run - 1 - k;
        for (; query < end; row += table_a, place = 0) {
          const int64_t count = smaller(run - place, end - query);
          body(key, query, count, row + place);
          query += count;
        }
      }
    }
  }
};

// The tokens of one window. The comments give shapes, such as (padded,).
template <typename T>
struct Tokens {
  int64_t index = -1;  // of the window
  int64_t *in, *out;   // (padded,): offsets of a token's row in qkv and in the output
  T* side;             // (padded,): mark of the token's side of the borders
  bool parted;         // some tokens have different sides

  void take(Arena& arena, int64_t padded) {
    in = arena.take<int64_t>(padded);
    out = arena.take<int64_t>(padded);
    side = arena.take<T>(padded);
  }

  // Finds the rows of a window's tokens, and their marks of sides. Where an axis does not wrap,
  // tokens beyond the border of the radius add 1 to the mark, and tokens beyond that of the azimuth
  // add 2. Token 0 pads the last group.
  template <typename S, typename Sizes>
  void find(const WindowAttentionArgs<S>& a, const Sizes& shape, int64_t window) {
    if (window == index) return;
    index = window;
    const int64_t wa = window % shape.windows_a, wr = window / shape.windows_a % shape.windows_r;
    const int64_t image = window / shape.map_windows, row = shape.heads * shape.d;
    parted = false;
    int64_t t = 0;
    for (int64_t tr = 0; tr < a.window_r; ++tr) {
      int64_t r = wr * a.window_r + tr + a.shift_r;
      const bool over_r = r >= a.rings;
      if (over_r) r -= a.rings;
      for (int64_t ta = 0; ta < a.window_a; ++ta, ++t) {
        int64_t sector = wa * a.window_a + ta + a.shift_a;
        const bool over_a = sector >= a.sectors;
        if (over_a) sector -= a.sectors;
        out[t] = ((image * a.rings + r) * a.sectors + sector) * row;
        in[t] = 3 * out[t];
        side[t] = static_cast<T>((over_r && !a.periodic_r) + 2 * (over_a && !a.periodic_a));
        parted |= side[t] != side[0];
      }
    }
    for (; t < shape.padded; ++t) {
      out[t] = out[0];
      in[t] = in[0];
      side[t] = side[0];
    }
  }
};

// The working memory of one thread.
template <typename S>
struct AttentionScratch {
  using T = Arithmetic<S>;

  Tokens<T> window, next;    // the current window and the next one
  int64_t* copy;             // (padded,): offsets of a token's row in a copy
  T* columns;                // (d, group): queries or gradients of a group, transposed
  T *largest, *inverse;      // (group,): of each query, the largest logit; 1 / sum of exponentials
  T *p, *dp;                 // (padded, group): logits, then probabilities, and their gradients
  T *pair_bias, *pair_grad;  // (heads, n, padded): biases of all pairs, and gradients of a chunk
  int64_t* bias_row;         // (heads,): the row of the bias that pair_bias holds
  T* group_bias;  // (eights, group): biases of a group, where there are no tables of pairs
  T *q_copy, *k_copy, *v_copy, *g_copy;  // (padded, d): rows of a head, widened; g: the gradient
  T *dq_copy, *dk_copy, *dv_copy;        // the same of results, yet to be rounded: forward's is dq

  template <typename Sizes>
  AttentionScratch(Arena& arena, const Sizes& shape) {
    const int64_t n = shape.n, padded = shape.padded;
    const int64_t pairs = shape.pairs ? shape.heads * n * padded : 0;
    const int64_t past = (shape.eights - n) * padded;  // keys are read in eights, past the last key
    const int64_t rows = sizeof(S) == sizeof(T) ? 0 : padded * shape.d;
    const int64_t results = shape.quantized ? padded * shape.d : rows;
    window.take(arena, padded);
    next.take(arena, padded);
    copy = arena.take<int64_t>(padded);
    columns = arena.take<T>(shape.d * kGroup);
    largest = arena.take<T>(kGroup);
    inverse = arena.take<T>(kGroup);
    p = arena.take<T>(padded * kGroup);
    dp = arena.take<T>(padded * kGroup);
    pair_bias = arena.take<T>(shape.pairs ? pairs + past : 0);
    pair_grad = arena.take<T>(pairs);
    bias_row = arena.take<int64_t>(shape.heads);
    group_bias = arena.take<T>(shape.pairs ? 0 : shape.eights * kGroup);
    q_copy = arena.take<T>(rows);
    k_copy = arena.take<T>(rows);
    v_copy = arena.take<T>(rows);
    g_copy = arena.take<T>(rows);
    dq_copy = arena.take<T>(results);
    dk_copy = arena.take<T>(rows);
    dv_copy = arena.take<T>(rows);
  }
};

}  // namespace
}  // namespace darswin
