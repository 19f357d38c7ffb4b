// Normalizes tokens, in one pass over memory.
//
// A row holds the features of one token. It fits the first-level cache, so memory is read only once
// although three loops go over the row. The first loop computes the mean. The second loop subtracts
// the mean and sums the differences and their squares. The third loop writes the normalized row.
//
// Subtracting the mean before squaring keeps digits that a large mean would cost. The mean is
// rounded, so the differences have a small mean of their own, which is subtracted too. The result
// may be 8-bit integers, which an integer product can read.
#include "../norm.h"

#include "quantize.h"

namespace darswin {
namespace {

constexpr int64_t kL = kLanes<float>;

using Half = Vector<float, kL / 2>;

// Calls body<V>(column, turn) for each whole register of a row, then for half a register, and then
// for each remaining column. The turns alternate between 0 and 1. With one sum for each turn, an
// addition does not wait for the one before.
template <typename Body>
inline void along(int64_t width, Body body) {
  int64_t c = 0;
  for (; c + 2 * kL <= width; c += 2 * kL) {
    body.template operator()<Floats>(c, 0);
    body.template operator()<Floats>(c + kL, 1);
  }
  for (; c + kL <= width; c += kL) body.template operator()<Floats>(c, 0);
  if constexpr (kL > 4) {
    for (; c + kL / 2 <= width; c += kL / 2) body.template operator()<Half>(c, 0);
  }
  for (; c < width; ++c) body.template operator()<float>(c, 0);
}

// Sums the lanes, half by half.
template <int kWide>
inline float total(Vector<float, kWide> v) {
  if constexpr (kWide == 2) {
    return v[0] + v[1];
  } else {
    struct {
      Vector<float, kWide / 2> lower, upper;
    } halves;
    __builtin_memcpy(&halves, &v, sizeof(v));
    return total<kWide / 2>(halves.lower + halves.upper);
  }
}

template <int... lane>
inline Floats joined(Half lower, Half upper, std::integer_sequence<int, lane...>) {
  return __builtin_shufflevector(lower, upper, lane...);
}

// A sum along a row: one register of sums for each turn, and the sum of the remaining columns.
struct Sum {
  Floats lanes[2]{};
  float rest = 0;
  void add(Floats v, int turn) { lanes[turn] += v; }
  void add(Half v, int) { lanes[0] += joined(v, Half{}, std::make_integer_sequence<int, kL>()); }
  void add(float v, int) { rest += v; }
  float all() const { return total<kL>(lanes[0] + lanes[1]) + rest; }
};

template <typename Out>
void norm_rows(const NormArgs<Out>& a, int64_t begin, int64_t end) {
  const Quantize quantize(a.quantizer);
  const float *const weight = a.weight, *const bias = a.bias;  // which bytes in `out` do not change
  const float part = 1 / static_cast<float>(a.width);
  for (int64_t row = begin; row < end; ++row) {
    const float* x = a.x + row * a.width;
    Out* out = a.out + row * a.width;
    Sum values, rest, squares;
    along(a.width, [&]<typename V>(int64_t c, int turn) { values.add(load<V>(x + c), turn); });
    const float mean = values.all() * part;
    along(a.width, [&]<typename V>(int64_t c, int turn) {
      const V left = load<V>(x + c) - mean;
      rest.add(left, turn);
      squares.add(left * left, turn);
    });
    const float more = rest.all() * part, variance = squares.all() * part - more * more;
    const float scale = 1 / __builtin_sqrtf((variance < 0 ? 0 : variance) + a.eps);
    const float shift = more * scale;
    along(a.width, [&]<typename V>(int64_t c, int) {
      const V unit = (load<V>(x + c) - mean) * scale - shift;
      const V normalized = unit * load<V>(weight + c) + load<V>(bias + c);
      if constexpr (is_same_v<Out, uint8_t>) {
        quantize(out + c, normalized);
      } else {
        store(out + c, normalized);
      }
    });
  }
}

}  // namespace

TIER_TABLE(NormKernels<float>) = {.rows = norm_rows};
TIER_TABLE(NormKernels<uint8_t>) = {.rows = norm_rows};

}  // namespace darswin
