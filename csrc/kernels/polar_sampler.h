// Forward of polar sampling: samples one token after another, from the packed image or directly.
#pragma once

#include "polar_bytes.h"
#include "polar_packed.h"
#include "polar_rows.h"

namespace darswin {
namespace {

template <typename T>
class Sampler {
 public:
  int64_t channels = 0;  // that take() has taken

  static int64_t bytes(const PolarSampleArgs<T>& a) {
    const int64_t values = a.packed ? packed_layout(a).size + 16 + 4 * a.width : 0;
    return round_up(sizeof(State), 64) + round_up(values * sizeof(T), 64);
  }

  // `strides` are those of the memory that ring() fills. There are three layouts. The channels may
  // be planes. Or each token is contiguous, or each row (one radius of all tokens) is contiguous
  // and has room for three values behind it.
  Sampler(const PolarSampleArgs<T>& args, const Strides& strides, void* scratch)
      : a(args),
        packed(packed_layout(args)),
        strides(strides),
        in_line(args.packed && args.tokens && args.channels <= 4 &&
                args.samples_a * args.channels >= 4 &&
                (args.samples_a <= kBlock || args.samples_r == 1) && reach_of_block() < INT32_MAX),
        state(*static_cast<State*>(scratch)),
        points(state.points),
        pixels(reinterpret_cast<T*>(static_cast<char*>(scratch) + round_up(sizeof(State), 64))) {
    if (!in_line) return;
    int64_t k = 0;
    for (int64_t row = 0, columns = block_columns(); k + columns <= kBlock; ++row) {
      for (int64_t sector = 0; sector * a.samples_a < columns; ++sector) {
        for (int64_t s = 0; s < smaller(columns, a.samples_a); ++s, ++k) {
          const int64_t to = row * strides.row + sector * strides.sector + s * a.channels;
          state.targets.target[k] = static_cast<int32_t>(to);
          const int64_t room = smaller((a.samples_a - s) * a.channels, kRoom);
          state.targets.room[k] = static_cast<int32_t>(room);
        }
      }
    }
  }

  // Takes the channels of image b from `first` on: four planes of a packed image, else all.
  void take(int64_t image, int64_t first) {
    b = image;
    channels = a.packed && !a.tokens ? smaller(a.channels - first, packed.pixel) : a.channels;
    if (!a.packed) return;
    with_pixel_type<T>(a.pixel, [&]<typename E>() {
      if (corners()) return pack_corners<T, E>(a, packed, b, first, pixels + packed.size, pixels);
      pack<T, E>(a, packed, b, first, pixels + packed.size + 16, pixels);
    });
  }

  // Samples the tokens of a ring of the image.
  void ring(int64_t ring, T* to) {
    ring_inside = a.packed && a.pixel == Pixel::u8;  // not needed otherwise
    for (int64_t n = 0; n < a.samples_r && ring_inside; ++n) {
      ring_inside = points.inside(a, b, ring * a.samples_r + n);
    }
    const int64_t columns = block_columns(), rows = smaller(kBlock / columns, a.samples_r);
    for (int64_t j = 0, count; j < a.num_azimuths; j += count) {
      // If a token has more points than a block, a block ends at the end of its token.
      const int64_t left =
          columns < a.samples_a ? a.samples_a - j % a.samples_a : a.num_azimuths - j;
      count = smaller(columns, left);
      for (int64_t row = 0; row < a.samples_r; row += rows) {
        block(ring, j, count, row, smaller(rows, a.samples_r - row), to);
      }
    }
  }

 private:
  struct State {
    PlacedPoints<T> points;
    Targets targets;
    ByteBlock bytes;
    T samples[4 * kBlock];
  };

  // Whether the image in hand has one channel, and its packed pixels have four pixels of it.
  bool corners() const { return !a.tokens && channels == 1 && a.pixel != Pixel::u8; }

  // A packed image has all channels of a pixel, or four of them if the samples are planes.
  static Packed packed_layout(const PolarSampleArgs<T>& a) {
    return a.packed ? Packed(a, a.tokens ? round_up(a.channels, 4) : 4) : Packed();
  }

  // Returns whether polar_bytes.h samples the image.
  static bool reads_bytes(const PolarSampleArgs<T>& a) {
    const double last =
        (static_cast<double>(a.height) - 1) * static_cast<double>(a.image_stride[2]) +
        (static_cast<double>(a.width) - 1) * static_cast<double>(a.image_stride[3]);
    return is_same_v<T, float> && a.pixel == Pixel::u8 && (a.channels == 1 || a.channels == 3) &&
           last < INT32_MAX;
  }

  // Returns a bound of the distance from the block's first point in the output to any other.
  int64_t reach_of_block() const {
    return smaller(kBlock, a.samples_r) * strides.row +
           block_columns() / a.samples_a * strides.sector;
  }

  // Returns the number of columns of a block. A block is a few whole tokens, so that their pixels
  // and their output stay in the first-level cache. Blocks are of equal size if this does not make
  // them small. If a token has more points than a block holds, it is cut into several blocks.
  int64_t block_columns() const {
    const int64_t sectors = a.num_azimuths / a.samples_a;
    const int64_t most = kBlock / (a.samples_r * a.samples_a);
    if (most < 1) return smaller(a.samples_a, kBlock);
    int64_t tokens = smaller(most, sectors);
    while (sectors % tokens != 0 && 2 * tokens > most) --tokens;
    return tokens * a.samples_a;
  }

  // Samples points j to j + count of `rows` radii of a ring, starting at its radius `row`.
  void block(int64_t ring, int64_t j, int64_t count, int64_t row, int64_t rows, T* to) {
    const int64_t first = ring * a.samples_r + row;
    T* out = to + j / a.samples_a * strides.sector + j % a.samples_a * strides.sample +
             row * strides.row;
    if (!a.packed) {
      for (int64_t n = 0; n < rows; ++n) {
        points.template find_direct<false>(a, a.image_stride + 2, b, first + n, j, count,
                                           n * count);
      }
      if (reads_bytes(a)) {
        sample_bytes(rows * count);
        return spread(rows, count, out);
      }
      with_pixel_type<T>(a.pixel, [&]<typename E>() { direct_lines<E>(j, rows, count, out); });
      return;
    }
    for (int64_t n = 0; n < rows; ++n) {
      points.find_packed(a, packed, b, first + n, j, count, n * count);
      if (a.tokens && strides.row == a.samples_a * a.channels && rows == a.samples_r) {
        // The tokens of the next block follow these in memory, so this prefetches their memory.
        const char* next =
            reinterpret_cast<const char*>(to + (j + count) / a.samples_a * strides.sector);
        const int64_t bytes = count * strides.row / a.samples_a * sizeof(T);
        for (int64_t e = n * bytes; e < (n + 1) * bytes; e += 64) __builtin_prefetch(next + e, 1);
      }
    }
    if (!a.tokens) return planes(rows, count, out);
    // The targets are computed for a whole block. They suit a smaller block only if all its points
    // have the same radius.
    if (in_line && (rows == 1 || count == smaller(block_columns(), a.num_azimuths))) {
      // If tokens have several rows, the memory behind their last row is already written. All other
      // memory is written later, except behind the last three points of the block.
      const bool last = row + rows == a.samples_r && a.samples_r > 1;
      const int64_t all = rows * count, last_row = last ? all - count : all - 3;
      return with_normalization([&]<Normalization how>() {
        sample_points<how>(a, pixels, packed.row, points.packed, last_row, all, state.targets, out);
      });
    }
    for (int64_t n = 0; n < rows; ++n) {
      packed_row(j, count, n * count, to + (row + n) * strides.row);
    }
  }

  template <typename Sample>
  void with_normalization(Sample sample) const {
    using enum Normalization;
    if (a.pixel != Pixel::u8) return sample.template operator()<none>();
    if constexpr (is_same_v<T, float>) {
      return ring_inside ? sample.template operator()<inside>()
                         : sample.template operator()<border>();
    }
  }

  // Samples the planes of a block, `rows` times `count` points of a packed image.
  void planes(int64_t rows, int64_t count, T* to) const {
    for (int64_t n = 0; n < rows && corners(); ++n) {
      sample_corners(pixels, points.packed, n * count, count, to + n * strides.row);
    }
    if (corners()) return;
    with_normalization([&]<Normalization how>() {
      for (int64_t n = 0; n < rows; ++n) {
        sample_planes<how>(a, pixels, packed.row, points.packed, n * count, count, channels,
                           strides.channel, to + n * strides.row);
      }
    });
  }

  // Samples points j to j + count of a radius, with any number of channels. Their places begin at
  // index `first`.
  void packed_row(int64_t j, int64_t count, int64_t first, T* row) const {
    for (int64_t k = 0; k < count; ++k) {
      T* to = row + (j + k) / a.samples_a * strides.sector + (j + k) % a.samples_a * a.channels;
      const T* pixel = pixels + points.packed.offset[first + k];
      const T right = points.packed.right[first + k], lower = points.packed.lower[first + k];
      const T *below = pixel + packed.row, *next = pixel + packed.pixel,
              *opposite = below + packed.pixel;
      const auto channel = [&](int64_t c) {
        return bilinear(pixel[c], next[c], below[c], opposite[c], right, lower);
      };
#pragma omp simd
      for (int64_t c = 0; c < a.channels; ++c) to[c] = channel(c);
      if constexpr (is_same_v<T, float>) {
        if (a.pixel != Pixel::u8) continue;
        const T coverage = channel(3);
        for (int64_t c = 0; c < a.channels; ++c) {
          to[c] = normalized(to[c], a.pixel_scale[c], a.pixel_offset[c], coverage);
        }
      }
    }
  }

  // The step between the channels of a sample in `state.samples`, and between its points.
  int64_t channel_step() const { return a.tokens ? 1 : kBlock; }
  int64_t point_step() const { return a.tokens ? a.channels : 1; }

  // Samples the first `count` points of a block of bytes, one after the other.
  void sample_bytes(int64_t count) const {
    if constexpr (is_same_v<T, float>) {
      const int64_t* stride = a.image_stride;
      const ByteImage bytes{static_cast<const uint8_t*>(a.image) + b * stride[0],
                            a.height,
                            a.width,
                            a.channels,
                            stride[2],
                            stride[3],
                            stride[1],
                            a.pixel_scale,
                            a.pixel_offset};
      const DirectPlaces<T>& at = points.direct;
      for (int64_t k = 0; k < count; k += kByteBlock) {
        const int64_t part = smaller(kByteBlock, count - k);
        T* to = state.samples + k * point_step();
        if (a.height > 1 && a.width > 1) {
          for (int64_t e = 0; e < part; ++e) {
            const int64_t offset = at.offset[k + e];
            state.bytes.offset[e] = offset < 0 ? 0 : static_cast<int32_t>(offset);
          }
          state.bytes.sample(bytes, at.right + k, at.lower + k, part);
          if (a.tokens) {
            state.bytes.write(a.channels, part, to);
          } else {
            for (int64_t c = 0; c < a.channels; ++c) {
              copy(state.bytes.samples[c], part, to + c * kBlock);
            }
          }
        }
        for (int64_t e = k; e < k + part; ++e, to += point_step()) {
          for (int64_t c = 0; c < a.channels && at.offset[e] < 0; ++c) {
            to[c * channel_step()] =
                border_sample(bytes, at.column[e], at.row[e], at.right[e], at.lower[e], c);
          }
        }
      }
    }
  }

  // Copies the samples of a block, `rows` times `count` points, to the output.
  void spread(int64_t rows, int64_t count, T* to) const {
    if (!a.tokens) {
      for (int64_t c = 0; c < a.channels; ++c) {
        const T* from = state.samples + c * kBlock;
        for (int64_t row = 0; row < rows; ++row, from += count) {
          copy(from, count, to + c * strides.channel + row * strides.row);
        }
      }
      return;
    }
    const int64_t part = smaller(a.samples_a, count), piece = part * a.channels;
    const T* from = state.samples;
    for (int64_t row = 0; row < rows; ++row) {
      T* out = to + row * strides.row;
      for (int64_t k = 0; k < count; k += part, from += piece, out += strides.sector) {
        copy(from, piece, out);
      }
    }
  }

  // Samples a block directly. The values behind a line of samples may be overwritten if the
  // token has more samples there, which come later. This holds for all lines except those that end
  // a row of the token.
  template <typename E>
  [[gnu::noinline]] void direct_lines(int64_t j, int64_t rows, int64_t count, T* to) const {
    const DirectImage<T, E> image(a, b, points.direct);
    if (a.gathers) {
      image.block(rows * count, {state.samples, point_step(), channel_step(), false});
      return spread(rows, count, to);
    }
    const bool joined = rows == 1 && strides.sector == a.samples_a * strides.sample;
    const Lines<T> lines(a, j, rows, count, joined ? count : a.samples_a, image.planes() > 1);
    const auto fetch = [&](const Line& line) { image.fetch(line); };
    const int64_t width = smaller(a.samples_a, count);
    visit_lines(lines, fetch, [&](const Line& line) {
      T* out =
          to + line.token * strides.sector + line.sample * strides.sample + line.row * strides.row;
      const int64_t step = line.flat ? strides.sample : strides.row;
      const bool spare = a.tokens && !line.flat && line.sample + 1 < width;
      image.sample(line, {out, step, strides.channel, spare});
    });
  }

  const PolarSampleArgs<T>& a;
  const Packed packed;
  const Strides strides;
  const bool in_line;
  State& state;
  PlacedPoints<T>& points;
  T* pixels;                 // packed image, then the rows that pack() converts
  int64_t b = 0;             // the image in hand
  bool ring_inside = false;  // all pixels around the points of the ring in hand are in the image
};

}  // namespace
}  // namespace darswin
