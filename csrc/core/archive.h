// Reads the arrays of a file that np.savez wrote: a zip archive of .npy files, not compressed.
#pragma once

#include <cstdint>
#include <cstdlib>
#include <map>
#include <memory>
#include <span>
#include <stdexcept>
#include <string>
#include <string_view>
#include <vector>

namespace darswin {

// An array of the archive, in C order. Its memory is aligned to cache lines.
struct ArchiveArray {
  std::string type;  // NumPy's name, such as "<f4"
  std::vector<int64_t> shape;
  int64_t count;  // of its numbers
  std::unique_ptr<char, decltype(&std::free)> data{nullptr, &std::free};
};

// All arrays of a file, in memory. What is wrong is a std::invalid_argument, or a std::system_error
// if the system cannot read the file. Damage is found by the CRC-32 of each array. No size that the
// file claims is trusted.
class Archive {
 public:
  explicit Archive(const std::string& path);

  bool has(std::string_view name) const { return arrays.find(name) != arrays.end(); }
  const ArchiveArray& array(std::string_view name) const;  // of any type
  // The array of this name and type, flat.
  template <typename T>
  std::span<const T> numbers(std::string_view name) const {
    const ArchiveArray& found = array(name, type_of<T>);
    return {reinterpret_cast<const T*>(found.data.get()), static_cast<size_t>(found.count)};
  }
  // An array that must have one number.
  template <typename T>
  T number(std::string_view name) const {
    const auto found = numbers<T>(name);
    if (found.size() != 1) wrong(name, "must be one number");
    return found[0];
  }
  // An array of strings, in UTF-8.
  std::vector<std::string> strings(std::string_view name) const;
  std::string text(std::string_view name) const;

 private:
  [[noreturn]] static void wrong(std::string_view name, const std::string& what);
  const ArchiveArray& array(std::string_view name, std::string_view type) const;
  template <typename T>
  static constexpr std::string_view type_of = "";

  std::map<std::string, ArchiveArray, std::less<>> arrays;
};

template <>
inline constexpr std::string_view Archive::type_of<int64_t> = "<i8";
template <>
inline constexpr std::string_view Archive::type_of<int32_t> = "<i4";
template <>
inline constexpr std::string_view Archive::type_of<int16_t> = "<i2";
template <>
inline constexpr std::string_view Archive::type_of<uint8_t> = "|u1";
template <>
inline constexpr std::string_view Archive::type_of<float> = "<f4";
template <>
inline constexpr std::string_view Archive::type_of<double> = "<f8";

}  // namespace darswin
