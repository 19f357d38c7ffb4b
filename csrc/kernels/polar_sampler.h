// Forward: samples one token after another, from the packed image or, if it is far, where it lies.
#pragma once

#include "polar_far.h"
#include "polar_interpolate.h"

namespace darswin {
namespace {

template <typename T>
class Sampler {
 public:
  static int64_t bytes(const PolarSampleArgs<T>& a) {
    const int64_t values = a.packed ? Packed(a).size + 16 + 4 * a.width : 0;
    return round_up(sizeof(State), 64) + values * static_cast<int64_t>(sizeof(T));
  }

  // Channel c of sample (row, s) of a sector's token goes to to[sector * sector_stride + row *
  // row_stride + s * C + c]. Either each token is contiguous, or each row, one radius of all
  // tokens, is and has room for three values behind it.
  Sampler(const PolarSampleArgs<T>& args, int64_t sector_stride, int64_t row_stride, void* scratch)
      : a(args),
        packed(args.packed ? Packed(args) : Packed()),
        sector_stride(sector_stride),
        row_stride(row_stride),
        in_line(args.packed && args.channels <= 4 && args.samples_a * args.channels >= 4 &&
                (args.samples_a <= kBlock || args.samples_r == 1) && reach_of_block() < INT32_MAX),
        state(*static_cast<State*>(scratch)),
        points(state.points),
        image(reinterpret_cast<T*>(static_cast<char*>(scratch) + round_up(sizeof(State), 64))) {
    if (!in_line) return;
    int64_t k = 0;
    for (int64_t row = 0, columns = block_columns(); k + columns <= kBlock; ++row) {
      for (int64_t sector = 0; sector * a.samples_a < columns; ++sector) {
        for (int64_t s = 0; s < smaller(columns, a.samples_a); ++s, ++k) {
          const int64_t to = row * row_stride + sector * sector_stride + s * a.channels;
          state.targets.place[k] = static_cast<int32_t>(to);
          state.targets.joined[k] = s + 4 <= a.samples_a;
        }
      }
    }
  }

  // Samples the tokens of a ring of image b.
  void ring(int64_t b, int64_t ring, T* to) {
    if (a.packed && b != image_in_hand) {
      with_pixel_type<T>(a.pixel, [&]<typename E>() {
        pack<T, E>(a, packed, b, image + packed.size + 16, image);
      });
      image_in_hand = b;
    }
    const int64_t columns = block_columns(), rows = smaller(kBlock / columns, a.samples_r);
    for (int64_t j = 0, count; j < a.num_azimuths; j += count) {
      // Where a token has more points than a block, no block reaches beyond its token.
      const int64_t left =
          columns < a.samples_a ? a.samples_a - j % a.samples_a : a.num_azimuths - j;
      count = smaller(columns, left);
      for (int64_t row = 0; row < a.samples_r; row += rows) {
        block(b, ring, j, count, row, smaller(rows, a.samples_r - row), to);
      }
    }
  }

 private:
  struct State {
    PlacedPoints<T> points;
    Targets targets;
    T samples[4 * kBlock];
  };

  // No point of a block is stored further than this from the block's first.
  int64_t reach_of_block() const {
    return smaller(kBlock, a.samples_r) * row_stride +
           block_columns() / a.samples_a * sector_stride;
  }

  // A block is a few whole tokens, so that their pixels and their output stay in the nearest cache.
  // Blocks are of equal size if that does not make them small. A token of more points than a block
  // holds is cut into several blocks.
  int64_t block_columns() const {
    const int64_t sectors = a.num_azimuths / a.samples_a;
    const int64_t most = kBlock / (a.samples_r * a.samples_a);
    if (most < 1) return smaller(a.samples_a, kBlock);
    int64_t tokens = smaller(most, sectors);
    while (sectors % tokens != 0 && 2 * tokens > most) --tokens;
    return tokens * a.samples_a;
  }

  // Points j to j + count of `rows` radii of a ring, from its radius `row` on.
  void block(int64_t b, int64_t ring, int64_t j, int64_t count, int64_t row, int64_t rows, T* to) {
    const int64_t first = ring * a.samples_r + row;
    T* out = to + j / a.samples_a * sector_stride + j % a.samples_a * a.channels + row * row_stride;
    if (!a.packed) {
      for (int64_t n = 0; n < rows; ++n) {
        points.template find_far<false>(a, a.image_stride + 2, b, first + n, j, count, n * count);
      }
      with_pixel_type<T>(a.pixel, [&]<typename E>() { far_lines<E>(b, j, rows, count, out); });
      return;
    }
    for (int64_t n = 0; n < rows; ++n) {
      points.find(a, packed, b, first + n, j, count, n * count);
      if (row_stride == a.samples_a * a.channels && rows == a.samples_r) {
        // The tokens of the next block come behind these: prefetches where they will be written.
        const char* next =
            reinterpret_cast<const char*>(to + (j + count) / a.samples_a * sector_stride);
        const int64_t bytes = count * row_stride / a.samples_a * sizeof(T);
        for (int64_t e = n * bytes; e < (n + 1) * bytes; e += 64) __builtin_prefetch(next + e, 1);
      }
    }
    // The targets are those of a whole block. They hold for a smaller block only if its points are
    // of one radius.
    if (in_line && (rows == 1 || count == smaller(block_columns(), a.num_azimuths))) {
      const int64_t all = rows * count, last_row = row + rows == a.samples_r ? all - count : all;
      const auto sample = [&]<bool kWeights>() {
        return sample_points<kWeights>(image, packed.row, points.near, last_row, all,
                                       smaller(a.samples_a, count), state.targets, a.channels, out);
      };
      if constexpr (kTryDifferences<T>) {
        if (sample.template operator()<false>()) return;
      }
      sample.template operator()<true>();
      return;
    }
    for (int64_t n = 0; n < rows; ++n) {
      near_row(j, count, n * count, to + (row + n) * row_stride);
    }
  }

  // Samples points j to j + count of one radius, whose places are `place` on, of any number of
  // channels.
  void near_row(int64_t j, int64_t count, int64_t place, T* row) const {
    for (int64_t k = 0; k < count; ++k) {
      T* to = row + (j + k) / a.samples_a * sector_stride + (j + k) % a.samples_a * a.channels;
      const T* pixel = image + points.near.offset[place + k];
      const T right = points.near.right[place + k], lower = points.near.lower[place + k];
      const T *below = pixel + packed.row, *next = pixel + packed.pixel,
              *opposite = below + packed.pixel;
#pragma omp simd
      for (int64_t c = 0; c < a.channels; ++c) {
        const T l = between(pixel[c], below[c], 1 - lower, lower);
        const T r = between(next[c], opposite[c], 1 - lower, lower);
        to[c] = between(l, r, 1 - right, right);
      }
    }
  }

  // Samples a block in the far image. What lies behind a line of samples may be overwritten where
  // the token has more of them, which come later: all but the lines that end a row of it.
  template <typename E>
  [[gnu::noinline]] void far_lines(int64_t b, int64_t j, int64_t rows, int64_t count, T* to) const {
    const FarImage<T, E> far(a, b, points.far);
    if (a.gathers) {
      far.block(rows * count, state.samples);
      const int64_t part = smaller(a.samples_a, count), piece = part * a.channels;
      const T* from = state.samples;
      for (int64_t row = 0; row < rows; ++row) {
        T* out = to + row * row_stride;
        for (int64_t k = 0; k < count; k += part, from += piece, out += sector_stride) {
          copy(from, piece, out);
        }
      }
      return;
    }
    const bool joined = rows == 1 && sector_stride == a.samples_a * a.channels;
    const Lines<T> lines(a, j, rows, count, joined ? count : a.samples_a, far.planes() > 1);
    const auto fetch = [&](const Line& line) { far.fetch(line); };
    const int64_t width = smaller(a.samples_a, count);
    visit_lines(lines, fetch, [&](const Line& line) {
      T* out = to + line.token * sector_stride + line.sample * a.channels + line.row * row_stride;
      if (line.flat) {
        far.sample(line, {out, a.channels, false});
      } else {
        far.sample(line, {out, row_stride, line.sample + 1 < width});
      }
    });
  }

  const PolarSampleArgs<T>& a;
  const Packed packed;
  const int64_t sector_stride, row_stride;
  const bool in_line;
  State& state;
  PlacedPoints<T>& points;
  T* image;  // packed, and after it the rows that pack() converts
  int64_t image_in_hand = -1;
};

}  // namespace
}  // namespace darswin
